#!/usr/bin/env bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# Runs README's shell commands, in their order, in a fresh clone on a fresh Debian: a minimal installation with git,
# make and this machine's Rust, in a separate folder. Prints the seconds of each command and `bar readme-commands-that-fail`.
# Needs root, for chroot, and the network.
#
#   scripts/readme.sh
#
# README_FOLDER   where the installation is kept (default target/readme); each run makes only a new clone
# README_RELEASE  Debian's release (default bookworm)
# MATRIX_MIRROR   Debian's package mirror (default: that of this machine's apt sources)
# README_OUT      logs of the commands (default out/readme)
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/lib.sh
. lab/scripts/bar_lines.sh
folder=$(realpath -m "${README_FOLDER:-${CARGO_TARGET_DIR:-target}/readme}")
release=${README_RELEASE:-bookworm}
out=$(realpath -m "${README_OUT:-out/readme}")
mkdir -p "$out"

mirror=${MATRIX_MIRROR:-$(mirror)}
why=$(folder_lacking "$mirror")
if [[ $why ]]; then
    skip "README's commands" "$why"
    bar readme-commands-that-fail - 0
    exit 1
fi
if [[ $(cat "$folder/made" 2>/dev/null) != "$release" ]]; then
    echo "readme: installing a minimal Debian $release into $folder"
    rm -rf "$folder"
    mkdir -p "$folder"
    install_debian "$release" "$folder" "$mirror" "$out/folder.log" --variant=minbase --include=ca-certificates,git,make || {
        bar readme-commands-that-fail - 0
        exit 1
    }
    echo "$release" >"$folder/made"
fi
rm -rf "$folder/root/entire"
git clone --quiet . "$folder/root/entire"
use_mirrors "$folder"

# Commands of README's blocks of shell, without their comments.
mapfile -t commands < <(awk '/^```sh$/ { on = 1; next } /^```/ { on = 0 } on && NF' README.md | sed 's/ *#.*//')
failed=0
if ((${#commands[@]} == 0)); then failed="no command was found"; fi
for ((i = 0; i < ${#commands[@]}; i++)); do
    began=$SECONDS ended=passed
    in_debian "$folder" "${RUSTUP_HOME:-$HOME/.rustup}=/root/.rustup" "${CARGO_HOME:-$HOME/.cargo}/bin=/root/.cargo/bin" -- \
        env -u CARGO_HOME -u RUSTUP_HOME -u CARGO_TARGET_DIR HOME=/root LANG=C.UTF-8 \
        PATH=/root/.cargo/bin:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin \
        bash -c "cd /root/entire && ${commands[i]}" >"$out/$((i + 1)).log" 2>&1 </dev/null || ended=failed
    echo "readme: ${commands[i]}: $ended in $((SECONDS - began)) s ($out/$((i + 1)).log)"
    if [[ $ended != passed ]]; then
        failed=$((failed + 1))
        tail -n 15 "$out/$((i + 1)).log"
    fi
done
rm -rf "$folder/root/entire"
bar readme-commands-that-fail "$failed" 0
exit "$short"
