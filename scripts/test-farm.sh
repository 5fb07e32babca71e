#!/usr/bin/env bash
# Tests `entire farm` end to end: processes of this machine, HyperQueue, Slurm, Cinema's reader, OpenJD's checker. What is not
# there and may not be installed is skipped by name.
#
#   scripts/test-farm.sh           all tests
#   scripts/test-farm.sh python    only makes the Python environment and prints its Python
#
# FARM_PYTHON   a Python that has hyperqueue, cinemasci and openjd-cli; else an environment is made in target/farm
set -euo pipefail
cd "$(dirname "$0")/.."
target=$(realpath -m "${CARGO_TARGET_DIR:-target}")
work=$(mktemp -d)
slurm=
trap '[[ -z $slurm ]] || lab/scripts/farm/slurm.sh stop "$work/slurm"; rm -rf "$work"' EXIT

skip() { # skip NAME REASON
    echo "test-farm: $1: skipped: $2" >&2
    [[ -z ${ENTIRE_SKIPPED:-} ]] || echo "test-farm $1: $2" >>"$ENTIRE_SKIPPED"
}

# The environment's packages, each with the version that was tried.
packages=(hyperqueue==0.27.0 cinemasci==1.7.9 openjd-cli==0.8.0)

python() {
    if [[ -n ${FARM_PYTHON:-} ]]; then
        echo "$FARM_PYTHON"
        return
    fi
    local folder=$target/farm
    if ! [[ -x $folder/bin/python ]]; then
        python3 -m venv "$folder" >&2 || return 1
    fi
    local package
    for package in "${packages[@]}"; do
        [[ -e $folder/made-${package%%=*} ]] && continue
        # Those that do not install here are skipped by name below.
        if "$folder/bin/python" -m pip install --quiet --disable-pip-version-check "$package" >&2; then
            touch "$folder/made-${package%%=*}"
        fi
    done
    echo "$folder/bin/python"
}

has() { "$python" -c "import $1" 2>/dev/null; }

python=$(python || true)
python=${python:-python3}
if [[ ${1:-} == python ]]; then
    echo "$python"
    exit 0
fi

${CARGO:-cargo} test --quiet --package entire-cli --test farm
${CARGO:-cargo} build --quiet --package entire-cli --bin entire
entire=$target/debug/entire

job() { # job NAME: 3 volumes, 8 views, 2 transfer functions
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

same() { # same NAME: the images of a job are those of the reference
    diff <(sums reference) <(sums "$1") >/dev/null || { echo "test-farm: $1: other images than the reference" >&2; exit 1; }
    echo "test-farm: $1: ok"
}

"$entire" farm "$(job reference)" --slots 2 --quiet >/dev/null
echo "test-farm: local: ok"

if has hyperqueue; then
    "$entire" farm "$(job hyperqueue)" --engine hyperqueue --python "$python" --slots 2 --quiet >/dev/null
    same hyperqueue
    # A worker's time limit, and a request that must stay below it.
    "$entire" farm "$(job limited)" --engine hyperqueue --python "$python" --slots 2 --time-limit 1h --quiet >/dev/null
    same limited
else
    skip hyperqueue "Python has no hyperqueue (pip install hyperqueue)"
fi

if ! command -v slurmctld >/dev/null && [[ $(id -u) == 0 ]] && command -v apt-get >/dev/null &&
    [[ ${ENTIRE_SETUP_INSTALL:-yes} != no ]]; then
    echo "test-farm: installing slurm-wlm and munge with apt-get"
    env DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends slurm-wlm munge >"$work/apt" 2>&1 || true
fi
if SLURM_CONF=$(lab/scripts/farm/slurm.sh start "$work/slurm" 2>"$work/slurm.log"); then
    slurm=yes
    export SLURM_CONF
    "$entire" farm "$(job slurm)" --engine slurm --quiet >/dev/null
    same slurm
else
    skip slurm "$(tail -n 1 "$work/slurm.log")"
fi

if has cinemasci; then
    "$python" scripts/read-cinema.py "$work/reference.cdb"
    echo "test-farm: cinema: ok"
else
    skip cinema "Python has no cinemasci (pip install cinemasci)"
fi

openjd=$(dirname "$python")/openjd
if [[ -x $openjd ]]; then
    "$entire" farm "$(job template)" --openjd "$work/template.json" --slots 2 --quiet >/dev/null
    "$openjd" check "$work/template.json"
    "$openjd" run "$work/template.json" --step Render -p Entire="$entire" >"$work/openjd.log" 2>&1 ||
        { tail -n 20 "$work/openjd.log" >&2; exit 1; }
    said=$("$entire" farm "$work/template.toml" --resume --quiet)
    grep -q ' 0 of them' <<<"$said" || { echo "test-farm: openjd: not all images were rendered: $said" >&2; exit 1; }
    same template
else
    skip openjd "there is no openjd (pip install openjd-cli)"
fi

if command -v pvbatch >/dev/null; then
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
    if command -v xvfb-run >/dev/null && [[ -z ${DISPLAY:-} ]]; then
        xvfb-run -a -s "-screen 0 1280x900x24 -noreset" "$entire" farm "$work/paraview.toml" --slots 1 --quiet
    else
        "$entire" farm "$work/paraview.toml" --slots 1 --quiet
    fi
    echo "test-farm: paraview: ok"
else
    skip paraview "there is no pvbatch (apt-get install paraview)"
fi
