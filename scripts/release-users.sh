#!/usr/bin/env bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# Tries the files of a rehearsed release as users do: with cargo, with pip and in C, each in a clean Debian, with at most three
# commands. Writes the number of commands of each user for `make bars-reach`. Needs root, for chroot, and the network.
#
#   scripts/release-users.sh [FOLDER]        default out/release, which scripts/release.sh makes
#
# The user of cargo finds the staged crates, and those that they need, in a folder that replaces the registry. Cargo, Rust and
# the settings of the package mirrors are those of this machine.
#
# RELEASE_DEBIAN  where the clean Debian is kept (default target/release-debian); each user gets a copy
# MATRIX_MIRROR   Debian's package mirror (default: that of this machine's apt sources)
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/lib.sh
folder=$(realpath "${1:-out/release}")
target=$(realpath -m "${CARGO_TARGET_DIR:-target}")
debian=$(realpath -m "${RELEASE_DEBIAN:-$target/release-debian}")
version=$(sed -n 's/^version = "\(.*\)"/\1/p' Cargo.toml | head -n 1)
# Debian stable has a newer C library than most machines on which a release is rehearsed.
release=stable
packages=ca-certificates,gcc,libc6-dev,pkg-config,python3,python3-venv
out=$PWD/out/reach
# The folder of the toolchain, with its programs in bin: rustup may be a package of the system, without ~/.cargo/bin.
rust=$(rustc --print sysroot)
mkdir -p "$out"

mirror=${MATRIX_MIRROR:-$(mirror)}
why=$(folder_lacking "$mirror")
[[ ! $why ]] || skip_all "users of a release" "$why"
if [[ $(cat "$debian/made" 2>/dev/null) != "$release $packages" ]]; then
    echo "release-users: installing a minimal Debian $release into $debian"
    rm -rf "$debian"
    mkdir -p "$debian"
    install_debian "$release" "$debian" "$mirror" "$out/debian.log" --variant=minbase --include="$packages" \
        --aptopt='Acquire::Check-Valid-Until "false"'
    echo "$release $packages" >"$debian/made"
fi
scratch=$(mktemp -d "$target/release-users.XXXX")
trap 'rm -rf "$scratch"' EXIT

# A registry in a folder: the crates that the workspace needs, and the staged ones.
"${CARGO:-cargo}" vendor --quiet --locked --versioned-dirs "$scratch/registry" >/dev/null
for crate in "$folder"/*.crate; do
    tar -C "$scratch/registry" -xzf "$crate"
    printf '{"files":{},"package":"%s"}' "$(sha256sum "$crate" | cut -d ' ' -f 1)" \
        >"$scratch/registry/$(basename "$crate" .crate)/.cargo-checksum.json"
done

# user NAME COMMAND...: runs the commands of a user in a clean Debian.
status=0
user() {
    local name=$1 place=$scratch/$1 command began=$SECONDS number=0
    shift
    cp -a "$debian" "$place"
    use_mirrors "$place"
    mkdir -p "$place/root/.cargo"
    printf '[source.crates-io]\nreplace-with = "staged"\n[source.staged]\ndirectory = "/registry"\n' >"$place/root/.cargo/config.toml"
    : >"$out/$name.log"
    for command; do
        number=$((number + 1))
        echo "\$ $command" >>"$out/$name.log"
        in_debian "$place" "$rust=/usr/local/rust" "$scratch/registry=/registry" "$folder=/staged" "$PWD/examples/c=/examples" -- \
            env -u CARGO_HOME -u RUSTUP_HOME -u CARGO_TARGET_DIR HOME=/root LANG=C.UTF-8 \
            PATH=/root/.cargo/bin:/usr/local/rust/bin:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin \
            bash -c "cd /root && $command" >>"$out/$name.log" 2>&1 </dev/null || {
            echo "release-users: $name: failed: $command"
            tail -n 15 "$out/$name.log"
            python3 lab/scripts/reach.py value "release-user-$name-commands" nan "failed: $command"
            status=1
            rm -rf "$place"
            return
        }
    done
    rm -rf "$place"
    python3 lab/scripts/reach.py value "release-user-$name-commands" "$number" "$((SECONDS - began)) s in a clean Debian"
    echo "release-users: $name: $number commands in $((SECONDS - began)) s"
}

user cargo "cargo install --quiet entire-cli" "entire doctor"
user pip "python3 -m venv venv" "venv/bin/pip install /staged/entire-$version-*.whl" \
    "venv/bin/python -c 'import entire; print(entire.models()); entire.Session(model=\"unshaded-selected\")'"
user c "tar -C /usr/local -xzf /staged/entire-$version-linux-*.tar.gz && ldconfig" \
    'gcc -o plan /examples/03_plan_observe.c $(pkg-config --cflags --libs entire) -lm' "./plan"
exit "$status"
