#!/usr/bin/env bash
# Checks for the programs and libraries that builds and renderers need, and installs missing packages of the distribution if
# this user has the rights. Prints its steps; a second run changes nothing. With ENTIRE_SETUP_INSTALL=no it only checks.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/lib.sh
# In Debian, the PATH of a user who is not root lacks the folders of ldconfig.
PATH=$PATH:/usr/sbin:/sbin
# The gate that will run: test, change or nightly (see scripts/test.sh); empty for `make demo`.
for=${ENTIRE_SETUP_FOR:-}

say() { printf 'setup: %s\n' "$*"; }

# True if this user may install packages with apt-get.
may_install() {
    [[ "${ENTIRE_SETUP_INSTALL:-yes}" != no ]] || return 1
    command -v apt-get >/dev/null || return 1
    [[ "$(id -u)" == 0 ]] && return 0
    command -v sudo >/dev/null && sudo -n true 2>/dev/null
}

as_root() {
    if [[ "$(id -u)" == 0 ]]; then "$@"; else sudo -n "$@"; fi
}

# install_packages REASON PACKAGE…: installs packages; true if all of them are installed afterwards.
install_packages() {
    local reason=$1
    shift
    local log
    log=$(mktemp)
    say "$reason: installing $* with apt-get"
    local get=(env DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends "$@")
    # On a machine of CI, dpkg need not flush files to disk.
    [[ -z ${CI:-} ]] || get+=(-o Dpkg::Options::=--force-unsafe-io)
    if as_root "${get[@]}" >"$log" 2>&1 ||
        { as_root apt-get update >"$log" 2>&1 && as_root "${get[@]}" >>"$log" 2>&1; }; then
        rm -f "$log"
        return 0
    fi
    say "apt-get failed:"
    tail -n 5 "$log" | sed 's/^/setup:   /'
    rm -f "$log"
    return 1
}

missing=0

# Rust. The oldest supported version is stated only in Cargo.toml.
wanted=$(sed -n 's/^rust-version = "\(.*\)"/\1/p' Cargo.toml | head -n 1)
say_rustup() {
    say "  curl --proto '=https' --tlsv1.2 -sSf https://sh.rustup.rs | sh -s -- -y"
    say "open a new shell and run this again."
    missing=1
}
if ! command -v cargo >/dev/null && may_install &&
    [[ -n "$(apt-cache policy rustup 2>/dev/null | sed -n 's/^ *Candidate: \([^(].*\)/\1/p')" ]]; then
    install_packages "no cargo" rustup && rustup default stable || true
fi
if ! command -v cargo >/dev/null; then
    say "no cargo. Install Rust $wanted or newer with this command:"
    say_rustup
else
    found=$(cargo --version | awk '{print $2}')
    if [[ "$(printf '%s\n%s\n' "$wanted" "$found" | sort -V | head -n 1)" == "$wanted" ]]; then
        say "cargo $found: ok"
    elif command -v rustup >/dev/null; then
        say "cargo $found is older than $wanted, which this workspace needs. Update it: rustup update stable && rustup default stable"
        missing=1
    else
        say "cargo $found is older than $wanted, which this workspace needs. Install Rust $wanted or newer with this command:"
        say_rustup
    fi
fi

# Disk space of the build, in GB. A linker that runs out of disk space ends with a bus error.
case $for in change) room=8 ;; nightly) room=30 ;; test) room=5 ;; *) room=2 ;; esac
target=${CARGO_TARGET_DIR:-target}
mkdir -p "$target"
free=$(df --output=avail --block-size=1G "$target" 2>/dev/null | tail -n 1 | tr -d ' ') || free=$room
# Existing build outputs count as free space. Their size is measured only if it is needed, since this can take seconds.
used=0
if ((free < room)); then
    used=$(du --summarize --block-size=1G "$target" 2>/dev/null | cut -f 1) || used=0
fi
if ((free + used < room)); then
    say "$target needs up to $room GB, and its disk has $free GB free: delete files, or set CARGO_TARGET_DIR to a folder on another disk"
    missing=1
fi

# A C compiler: Rust links with it, and the C examples and tests are built with it. Tests also need a C++ compiler.
# no_compiler: prints the language (C or C++) for which there is no compiler; prints nothing if no compiler is missing
no_compiler() {
    if ! command -v cc >/dev/null; then echo C; elif [[ $for ]] && ! command -v c++ >/dev/null; then echo C++; fi
}
language=$(no_compiler)
if [[ $language ]] && may_install; then
    install_packages "no $language compiler" gcc g++ libc6-dev || true
    language=$(no_compiler)
fi
if [[ ! $language ]]; then
    say "C compiler $(cc -dumpfullversion -dumpversion 2>/dev/null || true): ok"
else
    say "no $language compiler. Install one: apt-get install gcc g++ libc6-dev"
    missing=1
fi

# Vulkan: a loader, and a driver with a device. Mesa's software driver (lavapipe) always has one.
vulkan() {
    ldconfig -p 2>/dev/null | grep 'libvulkan\.so\.1' >/dev/null || return 1
    local named=${VK_DRIVER_FILES:-${VK_ICD_FILENAMES:-}}
    if [[ -n "$named" ]]; then
        local first=${named%%:*}
        [[ -f "$first" ]] && echo "$first" && return 0
        return 1
    fi
    local file hardware=""
    for file in /usr/share/vulkan/icd.d/*.json /etc/vulkan/icd.d/*.json /usr/local/share/vulkan/icd.d/*.json; do
        [[ -f "$file" ]] || continue
        [[ "$file" == *lvp_icd* ]] && echo "$file" && return 0
        hardware=$file
    done
    if [[ -n "$hardware" ]] && { compgen -G '/dev/dri/render*' >/dev/null || [[ -e /dev/nvidia0 ]]; }; then
        echo "$hardware"
        return 0
    fi
    return 1
}
if ! vulkan >/dev/null && may_install; then
    install_packages "no Vulkan driver" mesa-vulkan-drivers libvulkan1 || true
fi
if driver=$(vulkan); then
    say "Vulkan driver $(basename "$driver"): ok"
else
    say "no Vulkan driver. The CPU version of the raycaster renders instead (slower, almost the same pictures), and tests"
    say "that need Vulkan are reported as ignored. To install one: apt-get install mesa-vulkan-drivers libvulkan1"
fi

# Programs that tests use. If one is missing, the tests that need it are reported as ignored or skipped, never as passed.
packages=()
case $for in
    test | change | nightly)
        packages+=(cmake make ninja-build clang g++ pkg-config valgrind strace vulkan-validationlayers)
        ;;&
    change | nightly)
        # VTK and its Python, ParaView, a display, simulated user input for the window, and folders of other Debian releases.
        packages+=(libvtk9-dev python3-vtk9 python3-numpy python3-venv xvfb xauth xdotool mmdebstrap)
        read -ra paraview < <(paraview_packages)
        packages+=("${paraview[@]}")
        ;;&
    nightly)
        packages+=(slurm-wlm munge "${qt_libraries[@]}")
        ;;
esac
if ((${#packages[@]})) && command -v dpkg-query >/dev/null; then
    absent=()
    for package in "${packages[@]}"; do
        [[ $(dpkg-query -W -f '${db:Status-Status}' "$package" 2>/dev/null) == installed ]] || absent+=("$package")
    done
    if ((${#absent[@]})); then
        { may_install && install_packages "used by tests" "${absent[@]}"; } ||
            say "some tests will be skipped. To run them all: apt-get install ${absent[*]}"
    fi
fi

# Tools that only the gates use, in target/tools.
tools=$target/tools
pip_tool() { # pip_tool NAME VERSION: installs a program from PyPI if it is missing
    command -v "$1" >/dev/null || [[ -x $tools/bin/$1 ]] && return
    [[ "${ENTIRE_SETUP_INSTALL:-yes}" != no ]] && command -v python3 >/dev/null || return 0
    say "no $1: installing it into $tools"
    { [[ -x $tools/bin/pip ]] || python3 -m venv "$tools"; } >/dev/null 2>&1 &&
        "$tools/bin/pip" install --quiet --disable-pip-version-check --retries 1 --timeout 15 "$1==$2" >/dev/null 2>&1 ||
        say "$1 cannot be installed; its step will be skipped"
}
case $for in change | nightly) pip_tool typos 1.52.0 ;; esac
case $for in nightly) pip_tool zizmor 1.32.0 ;; esac
if [[ $for == nightly ]] && ! command -v cargo-deny >/dev/null && ! [[ -x $tools/bin/cargo-deny ]] &&
    [[ "${ENTIRE_SETUP_INSTALL:-yes}" != no ]]; then
    say "no cargo-deny: building it into $tools"
    cargo install --quiet --locked --root "$tools" cargo-deny || say "cargo-deny cannot be built; its step will be skipped"
fi

exit "$missing"
