#!/usr/bin/env bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# Builds the VTK adapter against an installed libentire, runs its tests, or a command with its Python module on a display.
#
#   plugins/vtk/run.sh build|asan
#   plugins/vtk/run.sh test [--full]
#   plugins/vtk/run.sh exec COMMAND...
#
# test leaves out tests that are marked `long` in Testing/CMakeLists.txt unless --full is given. asan builds adapter and
# tests with AddressSanitizer and runs the tests of re-entrant events.
#
# ENTIRE_SDK   the folder of an installed libentire (default: target/sdk, built like `make install`)
# VTK_PYTHON   the Python that has VTK's module (default /usr/bin/python3)
# VTK_OUT      folder of builds and results (default target/vtk)
# VTK_JOBS     parallel compilations (default: as many as the build tool takes)
set -euo pipefail
cd "$(dirname "$0")/../.."
. scripts/lib.sh
what=${1:-}
case $what in
    build | test | asan | exec) ;;
    *) echo "run.sh: unknown command \"$what\"; use build, test, asan or exec" >&2; exit 2 ;;
esac
out=${VTK_OUT:-$(realpath -m "${CARGO_TARGET_DIR:-target}")/vtk}
python=${VTK_PYTHON:-/usr/bin/python3}
export PYTHONPATH=$out/build/lib/python3/site-packages

name=test-vtk
if [[ $what == asan ]]; then name=test-vtk-asan; fi
lacks() { skip_all $name "$1"; }
command -v cmake >/dev/null || lacks "cmake is not installed (apt-get install cmake ninja-build g++ libvtk9-dev python3-vtk9 xvfb xauth)"
compgen -G "/usr/lib/*/cmake/vtk-9*/vtk-config.cmake" >/dev/null || [[ ${VTK_DIR:-} ]] ||
    lacks "VTK 9's development files are not installed (apt-get install libvtk9-dev python3-vtk9 xvfb xauth)"
python=$(command -v "$python") || { echo "run.sh: ${VTK_PYTHON:-/usr/bin/python3} is not a program; set VTK_PYTHON to the Python that has VTK's module" >&2; exit 2; }
command -v xvfb-run >/dev/null || lacks "xvfb-run is not installed (apt-get install xvfb xauth): VTK needs a display"

# build FOLDER OPTION...
build() { cmake_build plugins/vtk "$1" "$1." -DPython3_EXECUTABLE="$python" "${@:2}"; }

mkdir -p "$out"
case $what in
    build) build "$out/build" ;;
    test)
        command -v valgrind >/dev/null || skip $name "memory checks: valgrind is not installed (apt-get install valgrind)"
        build "$out/build"
        # Tests the installed package in a C++ program and in Python, as docs/src/vtk.md describes.
        rm -rf "$out/installed"
        cmake --install "$out/build" --prefix "$out/installed" >"$out/install.log"
        cmake_build plugins/vtk/Testing/installed "$out/user" "$out/user." \
            -Dentire_vtk_DIR="$out/installed/lib/cmake/entire_vtk"
        "$out/user/user" || { echo "FAILED: a program with the installed package" >&2; exit 1; }
        PYTHONPATH=$out/installed/lib/python3/site-packages "$python" -c \
            'from entire_vtk.vtkEntireSteering import vtkEntireSteering; vtkEntireSteering()'
        labels=(--label-exclude long)
        if [[ ${2:-} == --full ]]; then labels=(); fi
        # File for the reasons of skipped tests: features that this VTK does not have.
        export ENTIRE_TEST_SKIPS=$out/skips
        : >"$ENTIRE_TEST_SKIPS"
        status=0
        display ctest --test-dir "$out/build" --parallel 2 "${labels[@]}" --output-on-failure --output-junit "$out/tests.xml" || status=$?
        sort -u "$ENTIRE_TEST_SKIPS" | while read -r line; do skip $name "$line"; done
        exit $status
        ;;
    asan)
        build "$out/asan" -DENTIRE_SANITIZE=address -DENTIRE_PYTHON=OFF -DCMAKE_BUILD_TYPE=RelWithDebInfo
        # OpenGL and VTK leak, so leaks are not checked here; the tests under valgrind find leaks of the adapter.
        ASAN_OPTIONS=detect_leaks=0:abort_on_error=0:exitcode=99 display ctest --test-dir "$out/asan" \
            --label-regex reentry --output-on-failure
        ;;
    exec)
        build "$out/build"
        display "${@:2}"
        ;;
esac
