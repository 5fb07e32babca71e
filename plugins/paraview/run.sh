#!/usr/bin/env bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# Builds the ParaView plugin against an installed libentire, and loads and checks it.
#
#   plugins/paraview/run.sh build|screenshot
#   plugins/paraview/run.sh test [--full]      in pvbatch; --full: also in pvpython, on two ranks, on a server, in the client
#
# ENTIRE_SDK       the folder of an installed libentire (default: target/sdk, built like `make install`)
# PARAVIEW_OUT     folder of builds and results (default target/paraview)
# PARAVIEW_PYTHON  root of an unpacked python3-paraview package, if the package is not installed (it conflicts with
#                  python3-vtk9, which libvtk9-dev needs): apt-get download python3-paraview &&
#                  dpkg -x python3-paraview_*.deb FOLDER. By default apt-get downloads it into PARAVIEW_OUT.
# PARAVIEW_PANEL   OFF builds without the panel of the graphical client
set -euo pipefail
cd "$(dirname "$0")/../.."
. scripts/lib.sh
what=${1:-}
case $what in
    build | test | screenshot) ;;
    *) echo "run.sh: unknown command \"$what\"; use build, test or screenshot" >&2; exit 2 ;;
esac
out=${PARAVIEW_OUT:-$(realpath -m "${CARGO_TARGET_DIR:-target}")/paraview}
arch=$(gcc -print-multiarch 2>/dev/null || echo x86_64-linux-gnu)
# The CMake package, whose folder has the version in its name; the newest one if there are several.
cmake_dir=$(compgen -G "/usr/lib/$arch/cmake/paraview-*" | sort -V | tail -n 1 || true)

lacks() { skip_all test-paraview "$1"; }
command -v cmake >/dev/null || lacks "cmake is not installed (apt-get install cmake ninja-build g++)"
command -v pvbatch >/dev/null && [[ $cmake_dir ]] ||
    lacks "ParaView and its development files are not installed (apt-get install $(paraview_packages))"
command -v xvfb-run >/dev/null || lacks "xvfb-run is not installed (apt-get install xvfb xauth): ParaView needs a display"
mkdir -p "$out"

# Finds ParaView's Python modules: installed, in PARAVIEW_PYTHON, or downloaded and unpacked beside the build.
modules=
if [[ -e /usr/lib/python3/dist-packages/paraview ]]; then
    prefix=
else
    modules=${PARAVIEW_PYTHON:-$out/python3-paraview}
    if [[ ! -e $modules/usr/lib/python3/dist-packages/paraview ]]; then
        (mkdir -p "$modules" && cd "$modules" && apt-get download -q python3-paraview >/dev/null 2>&1 &&
            dpkg -x python3-paraview_*.deb . && rm -f python3-paraview_*.deb) ||
            lacks "python3-paraview is not installed and cannot be downloaded (set PARAVIEW_PYTHON)"
    fi
    # ParaView's CMake package requires the Python modules under its own prefix. Makes a prefix with links to the
    # package and the modules.
    prefix=$out/prefix
    if [[ ! -e $prefix/lib/$arch/cmake ]]; then
        rm -rf "$prefix" && mkdir -p "$prefix/lib/$arch/cmake"
        for each in include share; do ln -s /usr/$each "$prefix/$each"; done
        mkdir "$prefix/bin" && ln -s /usr/bin/* "$prefix/bin/"
        for each in "$modules"/usr/bin/*; do [[ ! -e $each ]] || ln -sf "$each" "$prefix/bin/"; done
        ln -s "$modules/usr/lib/python3" "$prefix/lib/python3"
        for each in /usr/lib/"$arch"/*; do
            [[ $each == */cmake || $each == */vtk ]] || ln -s "$each" "$prefix/lib/$arch/"
        done
        mkdir -p "$prefix/lib/$arch/vtk/hierarchy"
        ln -s "$modules/usr/lib/$arch/vtk/hierarchy/ParaView" "$prefix/lib/$arch/vtk/hierarchy/"
        cp -r "$cmake_dir" "$prefix/lib/$arch/cmake/"
    fi
    cmake_dir=$prefix/lib/$arch/cmake/$(basename "$cmake_dir")
    export PYTHONPATH=$modules/usr/lib/python3/dist-packages PARAVIEW_MODULES=$modules/usr/lib/python3/dist-packages
    export PARAVIEW_ROOT=$modules
fi

build() {
    cmake_build plugins/paraview "$out/build" "$out/" -DParaView_DIR="$cmake_dir" -DENTIRE_PANEL="${PARAVIEW_PANEL:-ON}"
    plugin=$(find "$out/build" -name EntireSteering.so | head -n 1)
    echo "paraview: built $plugin"
}

# Runs a command on a display of its own, which does not reset when its last client ends, for at most LIMIT seconds (default
# 600).
display() { timeout "${LIMIT:-600}" xvfb-run -a -s "-screen 0 1280x900x24 -noreset" "$@"; }

build
export ENTIRE_PLUGIN=$plugin
export OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1
case $what in
    build) ;;
    test) LIMIT=1200 display bash plugins/paraview/check.sh "$out" ${2:-} ;;
    screenshot) LIMIT=300 display bash plugins/paraview/screenshot.sh "$out" ;;
esac
