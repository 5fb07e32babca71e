#!/usr/bin/env bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# Builds the Python package, tests the built wheel, or measures it.
#
#   plugins/python/run.sh wheel|test|bars
#   plugins/python/run.sh exec COMMAND...      a command in the tests' environment, on a display
#
# PYTHON       the Python to make environments with (default python3)
# PYTHON_OUT   where environments go (default target/python)
set -euo pipefail
cd "$(dirname "$0")/../.."
what=${1:-}
case $what in
    wheel | test | bars | exec) shift ;;
    *) echo "run.sh: found word \"$what\"; use wheel, test, bars or exec" >&2; exit 2 ;;
esac
here=plugins/python
out=${PYTHON_OUT:-$(realpath -m "${CARGO_TARGET_DIR:-target}")/python}
python=${PYTHON:-python3}

lacks() {
    echo "python: skipped: $1"
    [[ -z ${ENTIRE_SKIPPED:-} ]] || echo "test-python: $1" >>"$ENTIRE_SKIPPED"
    exit 0
}
command -v "$python" >/dev/null || lacks "$python is not installed (apt-get install python3 python3-venv)"
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 9))' || lacks "$python is older than 3.9"
"$python" -c 'import ensurepip, venv' 2>/dev/null || lacks "Python's venv is not installed (apt-get install python3-venv)"

# environment NAME REQUIREMENTS: a virtual environment with exactly these packages, made once per list.
environment() {
    local folder=$out/$1 list=$here/$2
    if ! cmp -s "$list" "$folder/made-from"; then
        rm -rf "$folder"
        "$python" -m venv "$folder"
        "$folder/bin/python" -m pip install --quiet --disable-pip-version-check --no-deps --requirement "$list" >"$folder.log" 2>&1 || {
            tail -n 5 "$folder.log" >&2
            lacks "the packages of $list cannot be installed (is there a network?)"
        }
        cp "$list" "$folder/made-from"
    fi
}

wheel() {
    environment build requirements-build.txt
    rm -f out/wheels/entire-*
    mkdir -p out/wheels
    "$out/build/bin/maturin" build --release --locked --manifest-path $here/Cargo.toml --out out/wheels ${1:-} \
        >"$out/wheel.log" 2>&1 || { tail -n 40 "$out/wheel.log" >&2; exit 1; }
    ls -l out/wheels/entire-*
}

# The wheel in the environment that tests and bars run in.
installed() {
    wheel
    environment test requirements-test.txt
    "$out/test/bin/python" -m pip install --quiet --disable-pip-version-check --no-deps --no-index --force-reinstall \
        out/wheels/entire-*.whl
}

# A display that outlives its clients.
display() { xvfb-run -a -s "-screen 0 1280x1024x24 -noreset" "$@"; }

mkdir -p "$out"
case $what in
    wheel) wheel --sdist ;;
    test)
        command -v xvfb-run >/dev/null || lacks "xvfb-run is not installed (apt-get install xvfb xauth): VTK needs a display"
        installed
        cd $here
        PYTEST_DISABLE_PLUGIN_AUTOLOAD=1 display "$out/test/bin/python" -m pytest "$@" -rs | tee "$out/test.log"
        # What pytest skipped is part of the list of what did not run.
        if [[ ${ENTIRE_SKIPPED:-} ]]; then
            sed -n 's/^SKIPPED \[[0-9]*\] \([^:]*\):[0-9]*: \(.*\)/test-python: \1: \2/p' "$out/test.log" >>"$ENTIRE_SKIPPED"
        fi
        ;;
    bars)
        command -v xvfb-run >/dev/null || lacks "xvfb-run is not installed (apt-get install xvfb xauth): VTK needs a display"
        installed
        display "$out/test/bin/python" $here/bars/bars.py --wheels out/wheels --out out/python "$@"
        ;;
    exec)
        environment test requirements-test.txt
        display env PATH="$out/test/bin:$PATH" "$@"
        ;;
esac
