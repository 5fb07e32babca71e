#!/usr/bin/env bash
# Checks for what building and rendering need, and installs from the distribution what is missing where this user may.
# Says what it does; changes nothing the second time. ENTIRE_SETUP_INSTALL=no makes it only look.
set -euo pipefail
cd "$(dirname "$0")/.."

say() { printf 'setup: %s\n' "$*"; }

# How to run the package manager, or nothing where this user may not.
may_install() {
    [[ "${ENTIRE_SETUP_INSTALL:-yes}" != no ]] || return 1
    command -v apt-get >/dev/null || return 1
    [[ "$(id -u)" == 0 ]] && return 0
    command -v sudo >/dev/null && sudo -n true 2>/dev/null
}

as_root() {
    if [[ "$(id -u)" == 0 ]]; then "$@"; else sudo -n "$@"; fi
}

# install_packages REASON PACKAGE…: true when they are there afterwards.
install_packages() {
    local reason=$1
    shift
    local log
    log=$(mktemp)
    say "$reason: installing $* with apt-get"
    local get=(env DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends "$@")
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

# Rust. Its oldest version is stated once, in Cargo.toml.
wanted=$(sed -n 's/^rust-version = "\(.*\)"/\1/p' Cargo.toml | head -n 1)
[[ -x "$HOME/.cargo/bin/cargo" ]] && PATH="$HOME/.cargo/bin:$PATH"
if ! command -v cargo >/dev/null && may_install &&
    [[ -n "$(apt-cache policy rustup 2>/dev/null | sed -n 's/^ *Candidate: \([^(].*\)/\1/p')" ]]; then
    install_packages "no cargo" rustup && rustup default stable || true
fi
if ! command -v cargo >/dev/null; then
    say "no cargo. Install Rust $wanted or newer with the one command"
    say "  curl --proto '=https' --tlsv1.2 -sSf https://sh.rustup.rs | sh -s -- -y"
    say "open a new shell and run this again."
    missing=1
else
    found=$(cargo --version | awk '{print $2}')
    if [[ "$(printf '%s\n%s\n' "$wanted" "$found" | sort -V | head -n 1)" == "$wanted" ]]; then
        say "cargo $found: ok"
    else
        say "cargo $found is older than $wanted, which this workspace needs. Update it: rustup update stable"
        missing=1
    fi
fi

# A C compiler: Rust links with it, and the C examples and tests are built with it.
if ! command -v cc >/dev/null && may_install; then
    install_packages "no C compiler" gcc g++ libc6-dev || true
fi
if command -v cc >/dev/null; then
    say "C compiler $(cc -dumpfullversion -dumpversion 2>/dev/null || true): ok"
else
    say "no C compiler. Install one: apt-get install gcc g++ libc6-dev"
    missing=1
fi

# Vulkan: a loader, and a driver that has something to drive. Mesa's software driver (lavapipe) always has.
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
    say "no Vulkan driver. Rendering goes on with the CPU twin (slower, same pictures), and tests that need Vulkan are"
    say "reported as ignored. To have one: apt-get install mesa-vulkan-drivers libvulkan1"
fi

# What some tests use. Where one is missing, those tests are reported as ignored or skipped, never as passed.
if [[ "${ENTIRE_SETUP_FOR:-}" == tests ]]; then
    packages=()
    command -v cmake >/dev/null || packages+=(cmake make)
    command -v clang >/dev/null || packages+=(clang)
    command -v valgrind >/dev/null || packages+=(valgrind)
    command -v strace >/dev/null || packages+=(strace)
    command -v pkg-config >/dev/null || packages+=(pkg-config)
    compgen -G '/usr/share/vulkan/explicit_layer.d/VkLayer_khronos_validation.json' >/dev/null ||
        packages+=(vulkan-validationlayers)
    if ((${#packages[@]})); then
        { may_install && install_packages "used by some tests" "${packages[@]}"; } ||
            say "some tests will be skipped. To have them all: apt-get install ${packages[*]}"
    fi
fi

exit "$missing"
