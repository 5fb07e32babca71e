#!/usr/bin/env bash
# Records the frames by which the bars judge farm schedules: frames of an image database, and frames that the farm
# rendered before. Existing files are kept. Both recordings must be made with the same renderer: to record again, remove
# both files.
set -euo pipefail
out=$1 clock=$2
lab=${ENTIRE_LAB:-${CARGO_TARGET_DIR:-target}/release/entire-lab}
mkdir -p "$out"
common=(--clock "$clock" --size 256x256)

# Six volumes, 64 poses each, one transfer function, as for an image database. Schedules are judged
# by the median of five repeats.
if [ ! -e "$out/farm.json.gz" ]; then
    "$lab" record data/nyx_cosmology/m04/t0010.nrrd data/castro_blast/m04/t0012.nrrd \
        data/castro_blast/m05/t0012.nrrd data/maestroex_bubbles/m03/t0010.nrrd data/maestroex_bubbles/m03/t0015.nrrd \
        data/nyx_cosmology/m01/t0010.nrrd --enlarge 2 --hold 64 --path examples/paths/farm.json --steps 1,2 \
        --repeats 5 "${common[@]}" --name farm --out "$out/farm.part.json.gz" --resume
    mv "$out/farm.part.json.gz" "$out/farm.json.gz"
fi

# Frames that the farm rendered before: other volumes of the same simulations, other poses, the same transfer function.
if [ ! -e "$out/farm-training.json.gz" ]; then
    "$lab" record data/nyx_cosmology/m01/t0005.nrrd data/nyx_cosmology/m02/t0010.nrrd \
        data/castro_blast/m01/t0008.nrrd data/castro_blast/m02/t0012.nrrd data/maestroex_bubbles/m01/t0010.nrrd \
        data/maestroex_bubbles/m01/t0015.nrrd --enlarge 2 --hold 48 --path examples/paths/farm-training.json \
        --steps 1,2 --repeats 5 "${common[@]}" --name farm-training --out "$out/farm-training.part.json.gz" --resume
    mv "$out/farm-training.part.json.gz" "$out/farm-training.json.gz"
fi
