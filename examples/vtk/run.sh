#!/usr/bin/env bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# Builds the VTK adapter against an installed libentire and runs its tests, its comparison or its collectors.
#
#   examples/vtk/run.sh build|test|compare|bars
#
# VTK_PYTHON   the Python that has VTK's module (default /usr/bin/python3)
# VTK_OUT      where builds and results go (default target/vtk)
# VTK_REPEATS  repeats of the comparison (default 3)
# VTK_FRAMES   frames of the comparison's path (default 200)
set -euo pipefail
cd "$(dirname "$0")/../.."
what=${1:-}
case $what in
    build | test | compare | bars) ;;
    *) echo "run.sh: found word \"$what\"; use build, test, compare or bars" >&2; exit 2 ;;
esac
out=${VTK_OUT:-$PWD/${CARGO_TARGET_DIR:-target}/vtk}
sdk=$out/sdk
python=${VTK_PYTHON:-/usr/bin/python3}
export PYTHONPATH=$out/build/lib/python3/site-packages

lacks() {
    echo "vtk: skipped: $1"
    exit 0
}
command -v cmake >/dev/null || lacks "cmake is not installed (apt-get install cmake ninja-build g++ libvtk9-dev python3-vtk9 xvfb xauth)"
compgen -G "/usr/lib/*/cmake/vtk-9*/vtk-config.cmake" >/dev/null || [[ ${VTK_DIR:-} ]] ||
    lacks "VTK 9's development files are not installed (apt-get install libvtk9-dev python3-vtk9 xvfb xauth)"
python=$(command -v "$python") || { echo "run.sh: $python is no program; set VTK_PYTHON to the Python that has VTK's module" >&2; exit 2; }
command -v xvfb-run >/dev/null || lacks "xvfb-run is not installed (apt-get install xvfb xauth): VTK needs a display"

# A display that outlives its clients.
display() { xvfb-run -a -s "-screen 0 1280x1024x24 -noreset" "$@"; }

build() {
    [[ ${ENTIRE_SDK_READY:-} ]] || ffi/package/install.sh --prefix "$sdk" >/dev/null
    local generator=()
    if command -v ninja >/dev/null; then generator=(-G Ninja); fi
    cmake -S examples/vtk -B "$out/build" "${generator[@]}" -DCMAKE_PREFIX_PATH="$sdk" \
        -DPython3_EXECUTABLE="$python" >"$out/configure.log" 2>&1 ||
        { tail -n 20 "$out/configure.log" >&2; exit 1; }
    cmake --build "$out/build" >"$out/build.log" 2>&1 || { tail -n 40 "$out/build.log" >&2; exit 1; }
}

mkdir -p "$out"
build
case $what in
    build) ;;
    test) display ctest --test-dir "$out/build" --output-on-failure ;;
    compare | bars)
        "${CARGO:-cargo}" build --release --quiet --package entire-cli --bin entire
        display "$python" examples/vtk/python/bars.py --out "$out/bars" --entire "${CARGO_TARGET_DIR:-target}/release/entire" \
            --repeats "${VTK_REPEATS:-3}" --frames "${VTK_FRAMES:-200}" $([[ $what == compare ]] && echo --only-comparison)
        ;;
esac
