# shellcheck shell=bash
# Functions that the test scripts share. Source it: . scripts/lib.sh

have() { command -v "$1" >/dev/null 2>&1; }

# skip NAME REASON: prints that NAME is skipped, with the reason and the remedy, and adds it to the list of skips
# (CONTRIBUTING.md).
skip() {
    printf '%s: skipped: %s\n' "$1" "$2"
    [[ -z ${ENTIRE_SKIPPED:-} ]] || printf '%s: %s\n' "$1" "$2" >>"$ENTIRE_SKIPPED"
}

# Exit status of a script that skipped everything in a gate, so that scripts/test.sh does not count its step as passed.
skipped_all=75

# skip_all NAME REASON: as `skip`, and ends the script. Outside of a gate the exit status is 0.
skip_all() {
    skip "$1" "$2"
    end_skipped
}

# end_skipped: ends a script whose skips are all listed.
end_skipped() {
    [[ -z ${ENTIRE_SKIPPED:-} ]] || exit "$skipped_all"
    exit 0
}

# CMake's generator for new build folders. An existing folder keeps its own; cmake refuses another one as option.
if have ninja; then export CMAKE_GENERATOR=${CMAKE_GENERATOR:-Ninja}; fi

# Options of cmake that make compiler warnings errors, except the one on missing initializers: code that VTK generates leaves
# out fields of Python's type objects.
# shellcheck disable=SC2034
strict=(-DCMAKE_COMPILE_WARNING_AS_ERROR=ON -DCMAKE_CXX_FLAGS="-Wall -Wextra -Wno-missing-field-initializers")

# Packages that Qt needs to open windows.
# shellcheck disable=SC2034
qt_libraries=(libxcb-cursor0 libxcb-icccm4 libxcb-image0 libxcb-keysyms1 libxcb-render-util0 libxcb-xinerama0
    libxkbcommon-x11-0 libegl1 libdbus-1-3)

# paraview_packages [QT]: prints the packages of ParaView, and those that the CMake package of paraview-dev requires without
# depending on them. QT is the version of Qt, 5 or 6; by default that of this machine's ParaView.
paraview_packages() {
    local version=${1:-5} qt="qtbase5-dev libqt5svg5-dev qttools5-dev libqt5opengl5-dev"
    if [[ ! ${1:-} ]] && apt-cache depends paraview 2>/dev/null | grep libqt6 >/dev/null; then version=6; fi
    if [[ $version == 6 ]]; then qt="qt6-base-dev qt6-svg-dev qt6-tools-dev qt6-5compat-dev"; fi
    echo "paraview paraview-dev openmpi-bin $qt libutfcpp-dev libxml2-dev libhdf5-openmpi-dev libogg-dev libtheora-dev" \
        "libavformat-dev libswscale-dev libswresample-dev libgl2ps-dev libpng-dev libnetcdf-dev libgdal-dev libglew-dev" \
        "libdouble-conversion-dev libfreetype-dev"
}

# sdk: prints the folder of the installed C library. The gate installs it once and names the folder in ENTIRE_SDK. A script
# that runs alone installs it as `make install` does.
sdk() {
    if [[ -n ${ENTIRE_SDK:-} ]]; then
        echo "$ENTIRE_SDK"
        return
    fi
    local folder
    folder=$(realpath -m "${CARGO_TARGET_DIR:-target}")/sdk
    ffi/package/install.sh --prefix "$folder" >&2 || return 1
    echo "$folder"
}

# cmake_build SOURCE FOLDER LOGS OPTION...: configures and builds a CMake project against the installed C library, with
# VTK_JOBS parallel compilations if it is set. LOGS begins the names of both logs. If a step fails, prints the end of its log
# and ends the script.
cmake_build() {
    local source=$1 folder=$2 logs=$3 sdk
    shift 3
    sdk=$(sdk)
    cmake -S "$source" -B "$folder" -DCMAKE_PREFIX_PATH="$sdk" "${strict[@]}" "$@" >"${logs}configure.log" 2>&1 ||
        { tail -n 30 "${logs}configure.log" >&2; exit 1; }
    cmake --build "$folder" ${VTK_JOBS:+--parallel "$VTK_JOBS"} >"${logs}build.log" 2>&1 ||
        { tail -n 40 "${logs}build.log" >&2; exit 1; }
}

# display COMMAND...: runs a command on a display of its own, which does not reset when its last client ends.
display() { xvfb-run -a -s "-screen 0 1280x1024x24 -noreset" "$@"; }

# mirror: prints the address of Debian's packages, from apt's sources.
# shellcheck disable=SC2016
mirror() {
    apt-get indextargets --format '$(REPO_URI)' 'Origin: Debian' 'Created-By: Packages' 2>/dev/null |
        awk '!/-security/ { print; exit }' || true
}

# folder_lacking MIRROR: if this machine cannot install Debian into a folder and run commands in it, prints the reason and the
# remedy; prints nothing if it can.
folder_lacking() {
    local need
    [[ $(id -u) == 0 ]] || { echo "needs root for chroot (run it with sudo)"; return; }
    for need in mmdebstrap chroot unshare python3; do
        have $need || { echo "$need is not installed (apt-get install mmdebstrap coreutils util-linux python3)"; return; }
    done
    unshare --mount true 2>/dev/null || { echo "this machine gives no mount namespace (unshare --mount fails)"; return; }
    [[ $1 ]] || echo "apt knows no mirror of Debian (set MATRIX_MIRROR)"
}

# install_debian RELEASE FOLDER MIRROR LOG OPTION...: installs Debian into a folder by mmdebstrap with these options. If that
# fails, prints the last lines of its log and removes the folder.
install_debian() {
    local release=$1 folder=$2 mirror=$3 log=$4
    shift 4
    # When mmdebstrap ends, so do the mounts that it has made. Files are not flushed to disk one by one, since an incomplete
    # folder is installed again.
    unshare --mount mmdebstrap --mode=root --dpkgopt=force-unsafe-io "$@" \
        "$release" "$folder" "deb $mirror $release main" >"$log" 2>&1 || {
        echo "mmdebstrap failed:"
        tail -n 5 "$log"
        rm -rf "$folder"
        return 1
    }
}

# use_mirrors FOLDER: gives a folder with Debian the settings by which this machine reaches its package mirrors.
use_mirrors() {
    local folder=$1 file to
    for file in /etc/resolv.conf /etc/pip.conf "${PIP_CERT:-}" "${SSL_CERT_FILE:-}" "${CARGO_HOME:-$HOME/.cargo}/config.toml"; do
        [[ -f $file ]] || continue
        to=$file
        [[ $file != */config.toml ]] || to=/root/.cargo/config.toml
        mkdir -p "$folder/$(dirname "$to")"
        cp "$file" "$folder/$to"
    done
    [[ ! -d ${PIP_FIND_LINKS:-} ]] || { mkdir -p "$folder/$PIP_FIND_LINKS" && cp -r "$PIP_FIND_LINKS/." "$folder/$PIP_FIND_LINKS"; }
}

# in_debian FOLDER [SOURCE=TARGET]... -- COMMAND...: runs a command in the Debian that is installed in FOLDER, with each SOURCE
# of this machine mounted read-only at TARGET. Only the command's processes see the mounts, so no mount is left when they end.
# shellcheck disable=SC2016
in_debian() {
    local folder=$1 mounts=()
    shift
    while [[ $1 != -- ]]; do
        mounts+=("$1")
        shift
    done
    shift
    unshare --mount bash -euc '
        folder=$1 count=$2
        shift 2
        for mount in "${@:1:count}"; do
            mkdir -p "$folder${mount#*=}"
            mount --bind "${mount%%=*}" "$folder${mount#*=}"
            mount -o remount,bind,ro "$folder${mount#*=}"
        done
        mount -t proc proc "$folder/proc"
        mount --rbind /dev "$folder/dev"
        exec chroot "$folder" "${@:count+1}"
    ' in_debian "$folder" "${#mounts[@]}" "${mounts[@]}" "$@"
}

# Words before a command that in_debian runs: they give the command a clean environment. The caller mounts the C library at
# /sdk.
# shellcheck disable=SC2034
clean_environment=(env -i HOME=/root LANG=C.UTF-8 PATH=/usr/sbin:/usr/bin:/sbin:/bin PYTHONDONTWRITEBYTECODE=1 ENTIRE_SDK=/sdk)
