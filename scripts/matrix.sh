#!/usr/bin/env bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# Tests the VTK class and the ParaView plugin with the versions of other Debian releases. Each release is installed into a
# separate folder, in which the same scripts run as on the host: the same tests, with compiler warnings as errors.
# Results go to MATRIX_OUT/results.csv, logs beside it. Needs root, for chroot.
#
#   scripts/matrix.sh [host|stable|testing]...     default: all three
#   scripts/matrix.sh short [install]              only the short tests of the VTK class, with the version of Debian stable;
#                                                  install: makes the folder and runs no test
#
# MATRIX_FOLDERS  where the folders are kept (default target/matrix); a folder is made again if its list of packages has changed
# MATRIX_MIRROR   Debian's package mirror (default: that of this machine's apt sources)
# MATRIX_FRESH    if set, all folders are made again
# MATRIX_OUT      folder of results and logs (default out/matrix)
# ENTIRE_SDK      the folder of an installed libentire (default: target/sdk, into which the library is built and installed)
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/lib.sh
folders=$(realpath -m "${MATRIX_FOLDERS:-${CARGO_TARGET_DIR:-target}/matrix}")
out=$(realpath -m "${MATRIX_OUT:-out/matrix}")
names=("$@") short= install=
case $* in
    "") names=(host stable testing) ;;
    short) names=(stable) short=yes ;;
    "short install") names=(stable) short=yes install=yes ;;
esac
for name in "${names[@]}"; do
    case $name in
        host | stable | testing) ;;
        *) echo "matrix.sh: found word \"$name\"; use any of host, stable and testing, or short, or short install" >&2; exit 2 ;;
    esac
done

packages=(ca-certificates g++ cmake ninja-build pkg-config valgrind xvfb xauth libgl1-mesa-dri python3 python3-numpy
    libvtk9-dev python3-vtk9)
# Commands that run in the folder after its installation. They install ParaView's Python modules; in some releases these
# conflict with VTK's modules and are unpacked into another folder instead. The commands also link extension modules under
# names without Python's suffix, which the CMake packages of newer ParaView versions in Debian expect.
# shellcheck disable=SC2016
finish='export DEBIAN_FRONTEND=noninteractive
    apt-get install --yes --quiet --no-install-recommends --no-remove python3-paraview || {
        cd /tmp && apt-get download python3-paraview && dpkg -x python3-paraview_*.deb /opt/python3-paraview && rm python3-paraview_*.deb; }
    mkdir -p /opt/python3-paraview
    find /usr/lib/python3/dist-packages /opt/python3-paraview -name "*.cpython-3*.so" | while read -r file; do
        ln -sf "$(basename "$file")" "${file%.cpython-3*}.so"
    done'
if [[ $short ]]; then
    folders=$folders/short finish=:
else
    read -ra paraview < <(paraview_packages 6)
    packages+=("${paraview[@]}")
fi

mirror=${MATRIX_MIRROR:-$(mirror)}

# folder NAME: makes the folder if it is missing, if its list of packages has changed or if MATRIX_FRESH is set. Writes the
# seconds that this took into its file made-in.
folder() {
    local name=$1 folder=$folders/$1 began=$SECONDS list
    list=$(printf '%s\n' "${packages[@]}" "$finish")
    if [[ -z ${MATRIX_FRESH:-} && -e $folder/made-in && $(cat "$folder/made-from") == "$list" ]]; then
        echo "matrix: $name: $folder exists ($(du -shx "$folder" | cut -f 1))"
        return
    fi
    echo "matrix: $name: installing Debian $name from $mirror into $folder, some minutes and gigabytes: ${packages[*]}"
    rm -rf "$folder"
    mkdir -p "$folders"
    # Validity dates are ignored, since a mirror may lag behind.
    install_debian "$name" "$folder" "$mirror" "$out/$name-folder.log" \
        --variant=apt --include="$(IFS=,; echo "${packages[*]}")" \
        --aptopt='APT::Install-Recommends "false"' --aptopt='Acquire::Check-Valid-Until "false"' \
        --customize-hook="chroot \"\$1\" bash -euc '$finish'" || return 1
    rm -f "$folder"/var/cache/apt/archives/*.deb
    echo "$list" >"$folder/made-from"
    echo $((SECONDS - began)) >"$folder/made-in"
    echo "matrix: $name: $(chroot "$folder" dpkg-query -f '.\n' -W | wc -l) packages, $(du -shx "$folder" | cut -f 1), in $((SECONDS - began)) s"
}

# tests NAME PROGRAM COMMAND...: runs a suite, and adds its result (passed or failed) and its seconds to `suites`.
tests() {
    local name=$1 program=$2 began=$SECONDS ended=passed
    shift 2
    "$@" >"$out/$name-$program.log" 2>&1 || ended=failed
    echo "matrix: $name, $program: $ended in $((SECONDS - began)) s"
    if [[ $ended != passed ]]; then
        status=1
        grep -E 'Failed|FAILED|error|skipped:' "$out/$name-$program.log" | head -n 20 || true
    fi
    suites+=("$name,$program,$ended,$((SECONDS - began))")
}

mkdir -p "$out"
status=0 suites=() places=()
why=
if [[ " ${names[*]} " == *" stable "* || " ${names[*]} " == *" testing "* ]]; then why=$(folder_lacking "$mirror"); fi
library=$SECONDS
if [[ ! $install ]]; then sdk=$(sdk); fi
library=$((SECONDS - library))
for name in "${names[@]}"; do
    if [[ $name == host ]]; then
        here=$(realpath -m "${CARGO_TARGET_DIR:-target}")
        places+=("host=/=$here/vtk=$here/paraview")
        rm -rf "$here/vtk/tests.xml" "$here/paraview/check"
        tests host vtk env ENTIRE_SDK="$sdk" plugins/vtk/run.sh test --full
        tests host paraview env ENTIRE_SDK="$sdk" plugins/paraview/run.sh test --full
        continue
    fi
    if [[ $why ]]; then
        skip "test-matrix, Debian $name" "$why"
        continue
    fi
    if ! folder "$name"; then
        # A mirror that cannot be reached does not fail the gate of a change.
        if [[ $short ]]; then skip "test-matrix, Debian $name" "its packages cannot be installed (see $out/$name-folder.log)"; else status=1; fi
        continue
    fi
    if [[ $install ]]; then continue; fi
    glibc=$(chroot "$folders/$name" getconf GNU_LIBC_VERSION)
    if [[ $(printf '%s\n%s\n' "$glibc" "$(getconf GNU_LIBC_VERSION)" | sort -V | tail -n 1) != "$glibc" ]]; then
        skip "test-matrix, Debian $name" "the C library is built here against $(getconf GNU_LIBC_VERSION), and Debian $name has $glibc"
        continue
    fi
    rm -rf "$folders/$name/build"
    # This checkout and the C library are mounted read-only.
    within=(in_debian "$folders/$name" "$PWD=/entire" "$sdk=/sdk" -- "${clean_environment[@]}")
    if [[ $short ]]; then
        tests "$name" vtk "${within[@]}" VTK_OUT=/build/vtk /entire/plugins/vtk/run.sh test
        continue
    fi
    places+=("$name=$folders/$name=$folders/$name/build/vtk=$folders/$name/build/paraview")
    modules=()
    if [[ -e $folders/$name/opt/python3-paraview/usr ]]; then modules=(PARAVIEW_PYTHON=/opt/python3-paraview); fi
    tests "$name" vtk "${within[@]}" VTK_OUT=/build/vtk /entire/plugins/vtk/run.sh test --full
    tests "$name" paraview "${within[@]}" PARAVIEW_OUT=/build/paraview "${modules[@]}" \
        /entire/plugins/paraview/run.sh test --full
done
if ((${#places[@]})); then
    python3 lab/scripts/reach.py record --results "$out/results.csv" --library "$library" --suites "${suites[@]}" --places "${places[@]}" || status=1
fi
if ((status == 0 && ${#suites[@]} == 0)); then end_skipped; fi
exit $status
