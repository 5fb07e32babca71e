#!/usr/bin/env bash
# Tests `entire farm` end to end: processes of this machine, HyperQueue, Slurm, Cinema's reader, OpenJD's checker, ParaView.
# A part that is missing and cannot be installed is listed as skipped.
#
#   scripts/test-farm.sh           without Slurm
#   scripts/test-farm.sh --full    all tests
#   scripts/test-farm.sh python    only makes the Python environment and prints the path of its Python
#
# FARM_PYTHON   a Python that has hyperqueue, cinemasci and openjd-cli (default: an environment in target/farm)
# FARM_BIN      the command `entire` to test (default: the one that cargo builds here)
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/lib.sh
case ${1:-} in
    "" | --full | python) ;;
    *) echo "test-farm.sh: found word \"$1\"; use --full, python or nothing" >&2; exit 2 ;;
esac
target=$(realpath -m "${CARGO_TARGET_DIR:-target}")
work=$(mktemp -d)
slurm=
trap '[[ -z $slurm ]] || lab/scripts/farm/slurm.sh stop "$work/slurm"; rm -rf "$work"' EXIT
# Time limit of every command, so that none hangs; each takes only seconds.
within=(timeout --kill-after=10 120)

# The environment's packages, each with the tested version.
packages=(hyperqueue==0.27.0 cinemasci==1.7.9 openjd-cli==0.8.0)

# Makes the Python environment with these packages, and prints the path of its Python. If FARM_PYTHON is set, only prints it.
python() {
    if [[ -n ${FARM_PYTHON:-} ]]; then
        echo "$FARM_PYTHON"
        return
    fi
    local folder=$target/farm
    if ! [[ -x $folder/bin/pip ]]; then
        "${within[@]}" python3 -m venv --clear "$folder" >&2 || return 1
    fi
    local package
    for package in "${packages[@]}"; do
        [[ -e $folder/made-$package ]] && continue
        [[ ${ENTIRE_SETUP_INSTALL:-yes} != no ]] || continue
        # Tests that need a package which cannot be installed are listed as skipped below.
        if "${within[@]}" "$folder/bin/python" -m pip install --quiet --disable-pip-version-check --retries 1 \
            --timeout 15 "$package" >&2; then
            touch "$folder/made-$package"
        fi
    done
    echo "$folder/bin/python"
}

has() { "$python" -c "import $1" 2>"$work/has.log"; }
# lacks PACKAGE: prints the reason for which `has` returned false
lacks() { echo "$(tail -n 1 "$work/has.log") (pip install $1)"; }

python=$(python || true)
python=${python:-python3}
if [[ ${1:-} == python ]]; then
    echo "$python"
    exit 0
fi

if [[ -n ${FARM_BIN:-} ]]; then
    entire=$(realpath "$FARM_BIN")
else
    ${CARGO:-cargo} build --quiet --package entire-cli --bin entire
    entire=$target/debug/entire
fi
farm() { "${within[@]}" "$entire" farm "$@" --quiet; }

job() { # job NAME: writes a job file with 3 volumes, 8 views, 2 transfer functions
    cat >"$work/$1.toml" <<TOML
name = "$1"
sizes = ["64x64"]
[[volumes]]
files = ["$PWD/data/mr_banana.nrrd", "$PWD/data/castro_blast/m01/*.nrrd"]
[[cameras]]
kind = "semi-sphere"
views = 8
distances_radii = [2.5]
[[transfer]]
name = "one"
lobes = [[0.4, 0.01, 0.6]]
[[transfer]]
name = "two"
points = [[0, 0, 0, 0, 0], [0.5, 1, 0.5, 0, 0.1], [1, 1, 1, 1, 0.8]]
[renderer]
kind = "entire"
device = "cpu"
TOML
    echo "$work/$1.toml"
}

sums() { (cd "$work/$1.cdb" && find image -name '*.png' -print0 | sort -z | xargs -0 sha256sum); }

same() { # same NAME: fails unless the images of a job are those of the reference
    diff <(sums reference) <(sums "$1") >/dev/null || { echo "test-farm: $1: the images differ from those of the reference" >&2; exit 1; }
    echo "test-farm: $1: ok"
}

farm "$(job reference)" --slots 2 >/dev/null
echo "test-farm: local: ok"

if has hyperqueue; then
    farm "$(job hyperqueue)" --engine hyperqueue --python "$python" --slots 2 >/dev/null
    same hyperqueue
    # With a time limit of the workers, HyperQueue accepts only requests below this limit.
    farm "$(job limited)" --engine hyperqueue --python "$python" --slots 2 --time-limit 1h >/dev/null
    same limited
    # The workers that are started have the processors that a bundle requests.
    farm "$(job wide)" --engine hyperqueue --python "$python" --slots 1 --cpus 2 >/dev/null
    same wide
else
    skip "test-farm, hyperqueue" "$(lacks hyperqueue)"
fi

if [[ ${1:-} == --full ]]; then
    # From here on, Slurm's processes must be ended at exit.
    slurm=yes
    if SLURM_CONF=$("${within[@]}" lab/scripts/farm/slurm.sh start "$work/slurm" 2>"$work/slurm.log"); then
        export SLURM_CONF
        farm "$(job slurm)" --engine slurm >/dev/null
        same slurm
    else
        cat "$work/slurm.log" >&2
        skip "test-farm, slurm" "$(sed '/^$/d' "$work/slurm.log" | tail -n 1 | sed 's/^slurm.sh: //')"
    fi
fi

if has cinemasci; then
    "$python" scripts/read-cinema.py "$work/reference.cdb"
    echo "test-farm: cinema: ok"
else
    skip "test-farm, cinema" "$(lacks cinemasci)"
fi

openjd=$(dirname "$python")/openjd
if [[ -x $openjd ]]; then
    farm "$(job template)" --openjd "$work/template.json" --slots 2 >/dev/null
    "$openjd" check "$work/template.json"
    "${within[@]}" "$openjd" run "$work/template.json" --step Render -p Entire="$entire" >"$work/openjd.log" 2>&1 ||
        { tail -n 20 "$work/openjd.log" >&2; exit 1; }
    said=$(farm "$work/template.toml" --resume)
    grep -q ' 0 of them' <<<"$said" || { echo "test-farm: openjd: not all images were rendered: $said" >&2; exit 1; }
    same template
else
    skip "test-farm, openjd" "there is no openjd (pip install openjd-cli)"
fi

display=()
if command -v xvfb-run >/dev/null && [[ -z ${DISPLAY:-} ]]; then
    display=(xvfb-run -a -s "-screen 0 1280x900x24 -noreset")
fi
# If plugins/paraview/run.sh has unpacked ParaView's Python modules, they are used.
modules=${PARAVIEW_PYTHON:-$target/paraview/python3-paraview}/usr/lib/python3/dist-packages
if [[ -d $modules ]]; then export PYTHONPATH=$modules; fi
echo "import paraview.simple" >"$work/import.py"
if ! command -v pvbatch >/dev/null; then
    skip "test-farm, paraview" "there is no pvbatch (apt-get install paraview python3-paraview)"
elif ! "${within[@]}" pvbatch "$work/import.py" >"$work/pvbatch.log" 2>&1; then
    # Some distributions package pvbatch and its Python modules separately.
    skip "test-farm, paraview" "pvbatch: $(sed '/^$/d' "$work/pvbatch.log" | tail -n 1) (apt-get install python3-paraview)"
else
    cat >"$work/paraview.toml" <<TOML
name = "paraview"
sizes = ["64x64"]
[[volumes]]
files = ["$PWD/data/mr_banana.nrrd"]
[[cameras]]
kind = "orbit"
views = 4
elevation_deg = 20.0
distances_radii = [3.0]
[[transfer]]
name = "one"
lobes = [[0.4, 0.01, 0.6]]
[renderer]
kind = "pvbatch"
script = "$PWD/examples/farm/render_paraview.py"
timeout_s = 120
TOML
    "${within[@]}" ${display[@]+"${display[@]}"} "$entire" farm "$work/paraview.toml" --slots 1 --quiet
    [[ $(find "$work/paraview.cdb/image" -name "*.png" | wc -l) == 4 ]] ||
        { echo "test-farm: paraview: not all images were rendered" >&2; exit 1; }
    echo "test-farm: paraview: ok"
fi
