#!/usr/bin/env bash
# Collects timing tables of data/timings anew on this machine, as their manifests say (`entire collect --like`), with scene
# features. The first rendering of every frame is discarded, except in tables of the low-resolution proxy: LVRP renders a
# frame once. Makes out/tables/NAME.csv.gz for every NAME given; copy them to data/timings to train on them. After an
# interruption, the same command continues. Nothing else should run meanwhile.
#   DATA     the folder that holds ensembles/ and scans/
#   OUT      folder for the tables; default: out/tables
set -euo pipefail
cd "$(dirname "$0")/../.."
root=$PWD
data=${DATA:?name the folder that holds ensembles/ and scans/, for example make tables DATA=../shared/data TABLES=scatter-members}
entire=$(realpath -m "${ENTIRE:-${CARGO_TARGET_DIR:-target}/release/entire}")
out=$(realpath -m "${OUT:-out/tables}")
[[ $# -gt 0 ]] || { echo "name tables: $(cd data/timings && ls none-*.csv.gz local-*.csv.gz scatter-*.csv.gz | grep -v features | sed 's/\.csv\.gz//' | paste -sd' ')" >&2; exit 2; }
mkdir -p "$out"
cd "$data"
for name in "$@"; do
    if [[ ! -e $out/$name.csv.gz ]]; then
        resume=() warm_up=(--warm-up-repeats 1)
        [[ $name == *-@(64|24|18) ]] && warm_up=()
        [[ -e $out/$name.csv ]] && resume=(--resume)
        echo "==> $name"
        "$entire" collect --like "$root/data/timings/$name.csv.gz" --out "$out/$name.csv" "${warm_up[@]}" "${resume[@]}"
        gzip -9n "$out/$name.csv"
    fi
    # Low-resolution proxies are timed and never predicted.
    [[ $name == *-@(64|24|18) ]] || "$entire" features --data "$out/$name.csv.gz" --probe-sides 4,7 \
        --volumenet "$root/models/volumenet-128f2.safetensors"
done
