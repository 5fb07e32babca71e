#!/usr/bin/env bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# Builds the Python package, tests the built wheel, measures it, or draws the book's pictures with it.
#
#   plugins/python/run.sh wheel|sdist|bars|pictures
#   plugins/python/run.sh slicer [ARGUMENT…]               compares with Slicer's rule; arguments go to bars/slicer_rule.py
#   plugins/python/run.sh test [--full] [ARGUMENT…]        arguments go to pytest
#   plugins/python/run.sh exec ENVIRONMENT COMMAND...      runs a command in an environment of the tests, on a display
#
# Environments, each made once from its locked list requirements-NAME.txt:
#   test     the newest VTK and PyVista, trame, yt, notebooks, mypy
#   oldest   the oldest PyVista that finds plotter.entire by itself, and the oldest VTK that it accepts
#   qt       vispy and napari, on Qt
#   slicer   slicer-core, the libraries of 3D Slicer with a VTK of their own; only for Python 3.11
#   trame-slicer  trame-slicer, with the older slicer-core that it requires; only for Python 3.11
#   host     no list: the Python VTK_PYTHON with its own VTK, of a distribution or of ParaView (pvbatch)
#
# PYTHON               the Python that makes the environments (default python3)
# PYTHON_OUT           folder of the environments and logs (default target/python)
# PYTHON_ENVIRONMENTS  environments to test in (default "test", with --full "test oldest qt host slicer trame-slicer")
# ENTIRE_PROFILE       the cargo profile of the wheel (default release)
# ENTIRE_SHARED        if set, the wheel contains the native module of the gate's build, which is in profile dev
# VTK_PYTHON           the Python of the environment host (default /usr/bin/python3)
set -euo pipefail
cd "$(dirname "$0")/../.."
. scripts/lib.sh
what=${1:-}
case $what in
    wheel | sdist | test | bars | slicer | pictures | exec) shift ;;
    *) echo "run.sh: unknown command \"$what\"; use wheel, sdist, test, bars, slicer, pictures or exec" >&2; exit 2 ;;
esac
here=plugins/python
out=${PYTHON_OUT:-$(realpath -m "${CARGO_TARGET_DIR:-target}")/python}
python=${PYTHON:-python3}
vtk_python=${VTK_PYTHON:-/usr/bin/python3}

lacks() { skip_all test-python "$1"; }
command -v "$python" >/dev/null || lacks "$python is not installed (apt-get install python3 python3-venv)"
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 9))' || lacks "$python is older than 3.9 (set PYTHON to a newer one)"
"$python" -c 'import ensurepip, venv' 2>/dev/null || lacks "Python's venv is not installed (apt-get install python3-venv)"

# environment NAME: makes a virtual environment with exactly the packages of requirements-NAME.txt, once per list and version
# of Python. Fails, with the reason in `why`, if the packages cannot be installed.
environment() {
    local folder=$out/$1 list=$here/requirements-$1.txt version
    version=$("$python" -c 'import sys; print("%d.%d.%d" % sys.version_info[:3])')
    cmp -s "$list" "$folder/made-from" && grep -qx "version = $version" "$folder/pyvenv.cfg" && return
    rm -rf "$folder"
    "$python" -m venv "$folder"
    # Python compiles a module when it is first imported. Most modules of these packages are never imported.
    "$folder/bin/python" -m pip install --quiet --disable-pip-version-check --no-deps --no-compile --only-binary :all: \
        --requirement "$list" >"$folder.log" 2>&1 || {
        why="$list cannot be installed with $("$python" --version): $(grep -v '^$' "$folder.log" | tail -n 1 | cut -c 1-200)"
        return 1
    }
    cp "$list" "$folder/made-from"
}

# maturin WORD OPTION...: runs a command of maturin; prints the end of its log if it fails.
maturin() {
    "$out/build/bin/maturin" "$1" --manifest-path $here/Cargo.toml "${@:2}" >"$out/maturin-$1.log" 2>&1 || {
        tail -n 40 "$out/maturin-$1.log" >&2
        exit 1
    }
}

wheel() {
    environment build || lacks "$why"
    rm -f out/wheels/entire-*
    mkdir -p out/wheels
    local cargo=${CARGO:-cargo}
    if [[ ${ENTIRE_SHARED:-} ]]; then cargo=$PWD/$here/shared_cargo.sh; fi
    # `build --sdist` would build the wheel from the sdist, whose lock file lacks the other crates of the workspace.
    ENTIRE_CARGO=${CARGO:-cargo} CARGO=$cargo maturin build --profile "${ENTIRE_PROFILE:-release}" --strip --locked --out out/wheels
    ls -l out/wheels/entire-*
}

# installed NAME: makes an environment and installs the wheel in it, once.
declare -A with_wheel
installed() {
    [[ -z ${with_wheel[$1]:-} ]] || return 0
    environment "$1" || return
    "$out/$1/bin/python" -m pip install --quiet --disable-pip-version-check --no-deps --no-index --force-reinstall \
        out/wheels/entire-*.whl && with_wheel[$1]=yes
}

needs_display() {
    command -v xvfb-run >/dev/null || lacks "xvfb-run is not installed (apt-get install xvfb xauth): VTK needs a display"
}

# tests NAME ARGUMENT...: runs pytest in an environment; skipped tests are added to the list ENTIRE_SKIPPED.
tests() {
    local name=$1
    shift
    if ! installed "$name"; then
        if [[ $name == test ]]; then lacks "$why"; fi
        skip "test-python, $name" "$why"
        return
    fi
    printf '\n%s: %s\n' "$name" "$("$out/$name/bin/python" -m pip list --format freeze 2>/dev/null |
        grep -iE '^(numpy|vtk|pyvista|trame|trame-vtk|yt|vispy|napari|slicer-core|trame-slicer)=' | tee "$out/$name-versions.txt" | tr '\n' ' ')"
    echo "python==$("$out/$name/bin/python" -c 'import platform; print(platform.python_version())')" >>"$out/$name-versions.txt"
    run_pytest "$name" "$out/$name/bin/python" -m pytest "$@"
}

# Runs the tests in windows of Qt. Qt ends a process that cannot open a window, so a separate process tries it first.
qt_tests() {
    if installed qt && ! QT_QPA_PLATFORM=xcb display "$out/qt/bin/python" \
        -c 'from PyQt6.QtWidgets import QApplication; QApplication([])' >/dev/null 2>&1; then
        skip "test-python, qt" "Qt opens no window here (apt-get install ${qt_libraries[*]})"
    else
        tests qt tests/test_qt.py "$@"
    fi
}

# Runs the tests of entire.vtk with the VTK of VTK_PYTHON.
host_tests() {
    printf '\nhost: %s\n' "$vtk_python"
    if ! "$vtk_python" -c 'import sys, numpy, vtkmodules; sys.exit(sys.version_info < (3, 10))' 2>/dev/null; then
        skip "test-python, host" "$vtk_python has no VTK and NumPy, or is older than 3.10 (apt-get install python3-vtk9 python3-numpy)"
    elif ! installed oldest; then
        skip "test-python, host" "$why"
    else
        "$vtk_python" -c 'import platform
from vtkmodules.vtkCommonCore import vtkVersion
print(f"vtk=={vtkVersion.GetVTKVersion()}\npython=={platform.python_version()}")' >"$out/host-versions.txt"
        run_pytest host "$vtk_python" tests/host.py "$(echo "$out"/oldest/lib/python*/site-packages)" "$@"
    fi
}

# run_pytest NAME COMMAND...: runs pytest by a command and adds its output to the environment's log.
run_pytest() {
    local name=$1 status=0
    shift
    (cd $here && PYTEST_DISABLE_PLUGIN_AUTOLOAD=1 display "$@" -rs --durations 5) | tee "$out/$name-last.log" || status=$?
    cat "$out/$name-last.log" >>"$out/$name-pytest.log"
    if [[ ${ENTIRE_SKIPPED:-} ]]; then
        sed -n "s/^SKIPPED \[[0-9]*\] \([^:]*\):[0-9]*: \(.*\)/test-python, $name: \1: \2/p" "$out/$name-last.log" >>"$ENTIRE_SKIPPED"
    fi
    return $status
}

mkdir -p "$out"
case $what in
    wheel)
        wheel
        maturin sdist --out out/wheels
        ls -l out/wheels/entire-*.tar.gz
        ;;
    sdist)
        environment build || lacks "$why"
        maturin sdist --out out/wheels
        ;;
    test)
        needs_display
        wheel
        environments=test
        if [[ ${1:-} == --full ]]; then
            environments="test oldest qt host slicer trame-slicer"
            shift
        fi
        for name in ${PYTHON_ENVIRONMENTS:-$environments}; do
            rm -f "$out/$name-pytest.log" "$out/$name-versions.txt"
            case $name in
                test)
                    if (($#)); then
                        tests test --ignore tests/test_qt.py --ignore tests/test_slicer.py --ignore tests/test_trame_slicer.py "$@"
                        continue
                    fi
                    # Runs these tests in a process of their own: in a process that has run them, opening a window has
                    # crashed inside the GLX of Mesa 22.3.
                    tests test tests/test_integrations.py
                    tests test --ignore tests/test_qt.py --ignore tests/test_slicer.py --ignore tests/test_trame_slicer.py --ignore tests/test_integrations.py
                    ;;
                oldest) tests oldest tests/test_volume.py tests/test_session.py tests/test_vtk.py tests/test_modes.py tests/test_endings.py tests/test_window.py tests/test_pyvista.py "$@" ;;
                qt) qt_tests "$@" ;;
                trame-slicer) tests trame-slicer tests/test_trame_slicer.py "$@" ;;
                slicer) tests slicer tests/test_slicer.py tests/test_modes.py "$@" ;;
                host) host_tests tests/test_vtk.py tests/test_modes.py tests/test_endings.py tests/test_window.py "$@" ;;
                *) echo "run.sh: PYTHON_ENVIRONMENTS names \"$name\"; use test, oldest, qt, host, slicer and trame-slicer" >&2; exit 2 ;;
            esac
            # Results of the whole suite, for the table of tested versions (make versions).
            if [[ $# == 0 && -e $out/$name-versions.txt ]]; then
                "$python" lab/scripts/reach.py python --suites "$name" --places "$out"
            fi
        done
        ;;
    bars)
        needs_display
        wheel
        # Builds the C library. The bars compare the time to read an array in Python with that of entire_volume_new().
        "${CARGO:-cargo}" build --release --quiet --package entire-ffi
        installed test || lacks "$why"
        display "$out/test/bin/python" $here/bars/bars.py --wheels out/wheels --out out/python \
            --library "${CARGO_TARGET_DIR:-target}/release/libentire.so" "$@"
        ;;
    slicer)
        needs_display
        wheel
        installed slicer || lacks "$why"
        display "$out/slicer/bin/python" $here/bars/slicer_rule.py "$@"
        ;;
    pictures)
        needs_display
        wheel
        for name in test qt; do
            installed $name || lacks "$why"
            display "$out/$name/bin/python" $here/examples/pictures.py --environment $name --out docs/src/images "$@"
        done
        ;;
    exec)
        # Installs the wheel, if one was built.
        if compgen -G "out/wheels/entire-*.whl" >/dev/null; then
            installed "$1" || lacks "$why"
        else
            environment "$1" || lacks "$why"
        fi
        display env PATH="$out/$1/bin:$PATH" "${@:2}"
        ;;
esac
