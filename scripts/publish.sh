#!/usr/bin/env bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# Publishes the crates of this version that crates.io does not have yet, in the order of their dependencies. crates.io limits
# new crates to five at once and one more every ten minutes, so after a refusal the script waits and continues. It needs a
# token in CARGO_REGISTRY_TOKEN, or one that `cargo login` has stored.
#
# PUBLISH_WAIT  seconds before the next try after a refusal (default 610)
# PUBLISH_TRIES number of tries (default 12)
set -euo pipefail
cd "$(dirname "$0")/.."
cargo=${CARGO:-cargo}
version=$(sed -n 's/^version = "\(.*\)"/\1/p' Cargo.toml | head -n 1)
mapfile -t crates < <("$cargo" metadata --no-deps --format-version 1 | "${PYTHON:-python3}" -c '
import json, sys
print("\n".join(p["name"] for p in json.load(sys.stdin)["packages"] if p["publish"] != []))')
((${#crates[@]})) || { echo "publish.sh: cargo metadata names no crate to publish" >&2; exit 1; }
log=$(mktemp)
trap 'rm -f "$log"' EXIT
for ((try = 1; ; try++)); do
    packages=()
    for crate in "${crates[@]}"; do
        "$cargo" info --quiet --registry crates-io "$crate@$version" >/dev/null 2>&1 || packages+=(--package "$crate")
    done
    ((${#packages[@]})) || { echo "publish.sh: crates.io has all ${#crates[@]} crates of version $version"; exit 0; }
    echo "publish.sh: try $try: ${packages[*]}"
    # scripts/release.sh has built the crates from their packages.
    if "$cargo" publish --locked --no-verify "${packages[@]}" 2>&1 | tee "$log"; then continue; fi
    grep -q "429 Too Many Requests" "$log" || exit 1
    ((try < ${PUBLISH_TRIES:-12})) || { echo "publish.sh: crates.io still refuses new crates; run this again later" >&2; exit 1; }
    sleep "${PUBLISH_WAIT:-610}"
done
