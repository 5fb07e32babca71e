#!/usr/bin/env bash
# Distills the selected predictors into the paper's network: `entire collect --teacher` predicts many random frames of the
# training volumes with a selected predictor, and PredNet is trained on these predictions. Makes
# out/distill/SET-distilled.safetensors for every given SET (unshaded, local, scatter; default: all) and copies it into
# models/, where the accuracy study finds it.
#   DATA     the folder that holds ensembles/ (the volumes that data/timings/*-train.csv.gz name)
#   FRAMES   frames per volume; default: 10000, which take 130 MB and some minutes per set
#   EPOCHS   epochs of training; default: 18 to 30, depending on the set; 6 with START
#   START    a folder with SET-distilled.safetensors to start from if the teachers changed little (models, for example);
#            fewer frames and epochs suffice then
#   ONLY     ONLY=collect makes the labels, out/distill/SET.csv, and trains nothing
#   MODELS   folder for the models; default: models/
set -euo pipefail
cd "$(dirname "$0")/../.."
root=$PWD
data=${DATA:?name the folder that holds ensembles/, for example make distill DATA=../shared/data}
frames=${FRAMES:-10000}
entire=$(realpath -m "${ENTIRE:-${CARGO_TARGET_DIR:-target}/release/entire}")
out=$root/out/distill models=$(realpath -m "${MODELS:-models}") start=${START:+$(realpath "$START")}
mkdir -p "$out"
cd "$data"
for set in ${*:-unshaded local scatter}; do
    case $set in
    unshaded) table=none shade=none size=1024 epochs=${EPOCHS:-30} ;;
    local) table=local shade=local size=1024 epochs=${EPOCHS:-18} ;;
    scatter) table=scatter shade=scatter size=256 epochs=${EPOCHS:-24} ;;
    *) echo "no set $set; there are unshaded, local and scatter" >&2 && exit 2 ;;
    esac
    # The volumes of the training table.
    mapfile -t volumes < <(sed -n 's/^ *"path": "\(.*\)",$/\1/p' "$root/data/timings/$table-train.manifest.json")
    resume=()
    [[ -e $out/$set.csv ]] && resume=(--resume)
    echo "==> $set: $frames frames of each of ${#volumes[@]} volumes, predicted by models/$set-selected.safetensors"
    "$entire" collect "${volumes[@]}" --out "$out/$set.csv" "${resume[@]}" --frames "$frames" --repeats 1 --warm-up 0 \
        --seed 77 --enlarge 2 --max-size "$size" --shade "$shade" --teacher "$root/models/$set-selected.safetensors"
    [[ ${ONLY:-} != collect ]] || continue
    echo "==> $set: training"
    if [[ -n $start ]]; then
        network=(--fine-tune "$start/$set-distilled.safetensors" --learning-rate 2e-4 --epochs "${EPOCHS:-6}")
    else
        network=(--preset 12C256 --inputs volume_features,camera,resolution,transfer_function --sorted-lobes
            --volumenet "$root/models/volumenet-128f2.safetensors" --learning-rate 7e-4 --epochs "$epochs")
    fi
    "$entire" train --data "$out/$set.csv" --out "$out/$set-distilled.safetensors" --dtype f16 --clock cpu \
        "${network[@]}" --batch 256 \
        --split volume --validation-groups ensembles/nyx_cosmology/m02/t0018.nrrd \
        --test-groups ensembles/castro_blast/m01/t0014.nrrd
    cp "$out/$set-distilled.safetensors" "$models/"
done
