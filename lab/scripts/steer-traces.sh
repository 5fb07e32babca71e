#!/usr/bin/env bash
# Records the data of the steering bars: time curves of paths over held-out volumes, and calibration frames of other
# volumes. Existing files are kept; remove the folder to record again. After an interruption the
# same call continues: an unfinished trace has the name NAME.part.json.gz.
set -euo pipefail
out=$1 clock=$2 frames=$3 data=$4
lab=${ENTIRE_LAB:-${CARGO_TARGET_DIR:-target}/release/entire-lab}
mkdir -p "$out/traces" "$out/training"

# Paths over volumes outside of the repository: the bars depend on which of them exist.
found=() absent=() pairs=(isabel_wrf:isabel-switches viscous_fingers:fingers-cuts)
for pair in "${pairs[@]}"; do
    if [ -d "$data/ensembles/${pair%%:*}/run01" ] || [ -e "$out/traces/${pair#*:}.json.gz" ]; then
        found+=("${pair#*:}")
    else
        absent+=("${pair#*:}")
    fi
done
echo "volumes in $data (STEER_DATA=folder): paths ${found[*]:-none}${absent:+; not there, so left out of the bars: ${absent[*]}}"

# Three repeats: the oracle uses the median, and the noise is the scatter of the repeats around it.
common=(--clock "$clock" --size 256x256 --repeats 3)

if [ ! -e "$out/calibration.csv.gz" ]; then
    rm -f "$out/calibration.part.csv"
    "$lab" record data/castro_blast/m01/t0008.nrrd data/nyx_cosmology/m01/t0005.nrrd \
        data/maestroex_bubbles/m01/t0010.nrrd data/nyx_cosmology/m02/t0010.nrrd \
        --enlarge 2 --calibration 16 "${common[@]}" --out "$out/calibration.part.csv"
    gzip -9 -n <"$out/calibration.part.csv" >"$out/calibration.part.csv.gz"
    mv "$out/calibration.part.csv.gz" "$out/calibration.csv.gz"
    rm "$out/calibration.part.csv"
fi

record() { # record FOLDER NAME VOLUME... OPTION...
    local name=$2 to="$out/$1/$2.json.gz" part="$out/$2.part.json.gz"
    shift 2
    [ -e "$to" ] && return
    "$lab" record "$@" "${common[@]}" --name "$name" --out "$part" --resume
    mv "$part" "$to"
}
trace() { record traces "$@"; }
training() { record training "$@"; }

trace nyx-switches data/nyx_cosmology/m04/t0010.nrrd --enlarge 2 --generate switches --frames "$frames"
trace castro-cuts data/castro_blast/m05/t0012.nrrd --enlarge 2 --generate cuts --frames "$frames"
trace castro-drag data/castro_blast/m04/t0012.nrrd --enlarge 2 --generate drag --frames "$frames"
trace maestroex-fly-in data/maestroex_bubbles/m03/t0010.nrrd --enlarge 2 --generate fly-in --frames "$frames"
trace nyx-orbit data/nyx_cosmology/m04/t0010.nrrd --enlarge 2 --generate orbit --frames "$frames"
trace banana-resize data/mr_banana.nrrd --generate switches --frames "$frames" \
    --scales "0:1,$((frames / 3)):0.6,$((2 * frames / 3)):1.2"
trace maestroex-series data/maestroex_bubbles/m03/t0010.nrrd data/maestroex_bubbles/m03/t0015.nrrd \
    --enlarge 2 --hold 12 --generate orbit --frames "$frames"
for pair in "${pairs[@]}"; do
    first=$(find "$data/ensembles/${pair%%:*}/run01" -name '*.nrrd' 2>/dev/null | sort | head -n 1 || true)
    [ -n "$first" ] && trace "${pair#*:}" "$first" --enlarge 2 --generate "${pair##*-}" --frames "$frames"
done

# Paths for choosing the controller's constants: other volumes than those of the paths above.
training train-switches data/nyx_cosmology/m01/t0005.nrrd --enlarge 2 --generate switches --frames 64
training train-cuts data/castro_blast/m01/t0008.nrrd --enlarge 2 --generate cuts --frames 64
training train-drag data/nyx_cosmology/m02/t0010.nrrd --enlarge 2 --generate drag --frames 64
training train-fly-in data/castro_blast/m02/t0012.nrrd --enlarge 2 --generate fly-in --frames 64
training train-orbit data/maestroex_bubbles/m01/t0010.nrrd --enlarge 2 --generate orbit --frames 64
training train-resize data/castro_blast/m01/t0008.nrrd --enlarge 2 --generate switches --frames 64 \
    --scales 0:1,21:0.6,42:1.2
training train-series data/maestroex_bubbles/m01/t0010.nrrd data/maestroex_bubbles/m01/t0015.nrrd \
    --enlarge 2 --hold 8 --generate orbit --frames 64

ENTIRE_LAB=$lab bash lab/scripts/farm/traces.sh "$out" "$clock"
