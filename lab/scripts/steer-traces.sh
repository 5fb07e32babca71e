#!/usr/bin/env bash
# Records what the steering bars are taken from: calibration frames of volumes that the paths do not show, and the cost
# curves of paths over volumes that the calibration did not see. What is there stays; remove the folder to record anew.
set -euo pipefail
out=$1 clock=$2 frames=$3 data=$4
lab=${ENTIRE_LAB:-target/release/entire-lab}
mkdir -p "$out/traces"

# Paths over volumes beside those of the repository: which bars are taken from them depends on what is there.
found=() absent=()
for pair in isabel_wrf:isabel-switches viscous_fingers:fingers-cuts; do
    if [ -d "$data/ensembles/${pair%%:*}/run01" ] || [ -e "$out/traces/${pair#*:}.json" ]; then
        found+=("${pair#*:}")
    else
        absent+=("${pair#*:}")
    fi
done
echo "volumes in $data (STEER_DATA=folder): paths ${found[*]:-none}${absent:+; not there, so left out of the bars: ${absent[*]}}"

common=(--clock "$clock" --size 256x256)

if [ ! -e "$out/calibration.csv" ]; then
    rm -f "$out/calibration.part.csv"
    "$lab" record data/castro_blast/m01/t0008.nrrd data/nyx_cosmology/m01/t0005.nrrd \
        data/maestroex_bubbles/m01/t0010.nrrd data/nyx_cosmology/m02/t0010.nrrd \
        --enlarge 2 --calibration 16 --repeats 2 "${common[@]}" --out "$out/calibration.part.csv"
    mv "$out/calibration.part.csv" "$out/calibration.csv"
fi

trace() { # trace NAME VOLUME... -- OPTION...
    local name=$1
    shift
    local to="$out/traces/$name.json"
    [ -e "$to" ] && return
    "$lab" record "$@" "${common[@]}" --name "$name" --out "$out/part.json"
    mv "$out/part.json" "$to"
}

trace nyx-switches data/nyx_cosmology/m04/t0010.nrrd --enlarge 2 --generate switches --frames "$frames"
trace castro-cuts data/castro_blast/m05/t0012.nrrd --enlarge 2 --generate cuts --frames "$frames"
trace castro-drag data/castro_blast/m04/t0012.nrrd --enlarge 2 --generate drag --frames "$frames"
trace maestroex-fly-in data/maestroex_bubbles/m03/t0010.nrrd --enlarge 2 --generate fly-in --frames "$frames"
trace nyx-orbit data/nyx_cosmology/m04/t0010.nrrd --enlarge 2 --generate orbit --frames "$frames"
trace banana-resize data/mr_banana.nrrd --generate switches --frames "$frames" \
    --scales "0:1,$((frames / 3)):0.6,$((2 * frames / 3)):1.2"
trace maestroex-series data/maestroex_bubbles/m03/t0010.nrrd data/maestroex_bubbles/m03/t0015.nrrd \
    --enlarge 2 --hold 12 --generate orbit --frames "$frames"
if [ -d "$data/ensembles" ]; then
    v="$data/ensembles/isabel_wrf/run01"
    first=$(find "$v" -name '*.nrrd' 2>/dev/null | sort | head -n 1 || true)
    [ -n "$first" ] && trace isabel-switches "$first" --enlarge 2 --generate switches --frames "$frames"
    v="$data/ensembles/viscous_fingers/run01"
    first=$(find "$v" -name '*.nrrd' 2>/dev/null | sort | head -n 1 || true)
    [ -n "$first" ] && trace fingers-cuts "$first" --enlarge 2 --generate cuts --frames "$frames"
fi

ENTIRE_LAB=$lab bash lab/scripts/farm/traces.sh "$out" "$clock"
