#!/usr/bin/env bash
# Studies this machine's Vulkan device in at most nine minutes, with the programs and volumes of this folder, which
# lab/scripts/gpu-study.sh makes. Writes results and report.txt into OUT. A second run continues with the missing steps;
# the exit status is 1 if steps are missing. Settings, by environment variables:
#   OUT                    folder for the results; default: results/
#   LIMIT                  limit of wall seconds for all steps
#   DEVICE, CLOCK, SHADES  renderer, clock of frame times, shading modes to study
#   FRAMES, MAX_SIZE       frames of each volume in a table, and their longest image side in pixels
#   ENLARGE, LARGE         enlargement of the volumes along each axis, and that of the large volumes; LARGE=0 for none
#   CALIBRATION            seconds of a calibration
set -euo pipefail
# In Debian, the PATH of a user who is not root lacks the folders of ldconfig.
PATH=$PATH:/usr/sbin:/sbin
here=$(cd "$(dirname "$0")" && pwd)
out=${OUT:-$here/results}
mkdir -p "$out/logs" "$out/done"
out=$(cd "$out" && pwd)
cd "$here"
limit=${LIMIT:-530} device=${DEVICE:-vulkan} clock=${CLOCK:-device} frames=${FRAMES:-40} max_size=${MAX_SIZE:-1024}
enlarge=${ENLARGE:-2} large=${LARGE:-6} calibration=${CALIBRATION:-40}
read -ra shades <<<"${SHADES:-none local scatter}"
# If the system has no Vulkan loader, that of this folder is used. If it has no manifest of a driver, one is written.
if [[ -e lib/libvulkan.so.1 ]] && ! ldconfig -p 2>/dev/null | awk '/libvulkan\.so\.1 / { found = 1 } END { exit !found }'; then
    export LD_LIBRARY_PATH="$here/lib${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}"
fi
if ! compgen -G "/usr/share/vulkan/icd.d/*.json" >/dev/null && ! compgen -G "/etc/vulkan/icd.d/*.json" >/dev/null &&
    [[ -z ${VK_DRIVER_FILES:-}${VK_ICD_FILENAMES:-} ]]; then
    for driver in libGLX_nvidia.so.0 libEGL_nvidia.so.0; do
        if ldconfig -p 2>/dev/null | awk -v d="$driver" '$1 == d { found = 1 } END { exit !found }'; then
            printf '{"file_format_version": "1.0.0", "ICD": {"library_path": "%s", "api_version": "1.3.0"}}\n' "$driver" >"$out/icd.json"
            export VK_DRIVER_FILES="$out/icd.json" VK_ICD_FILENAMES="$out/icd.json"
            break
        fi
    done
fi
trap 'echo "stopped; the same command continues from here" >&2; exit 130' INT

steps=()
# step NAME SECONDS ARGUMENTS: runs `entire ARGUMENTS` with a time limit, unless an earlier run has finished the step. At the
# limit, the command is asked to end, as by Ctrl-C. A table that its own limit cut short counts as finished.
step() {
    local name=$1 own=$2 left=$((limit - SECONDS)) begin=$SECONDS code=0 state=done
    shift 2
    if [[ ! -e $out/done/$name ]]; then
        if ((left < 1)); then
            state="left out: the time ran out; raise LIMIT, or run the command again"
        else
            timeout --foreground --signal=INT --kill-after=10 "$((own < left ? own : left))" \
                bin/entire "$@" >"$out/logs/$name.txt" 2>&1 || code=$?
            if [[ $code == 124 && $1 == collect ]] && ((own <= left)); then
                code=0 state="cut short"
            elif ((code != 0)); then
                state="failed with status $code: $(tail -n 1 "$out/logs/$name.txt")"
            fi
            if ((code == 0)); then echo "$state, $((SECONDS - begin)) s" >"$out/done/$name"; fi
        fi
    fi
    if [[ -e $out/done/$name ]]; then state=$(<"$out/done/$name"); fi
    steps+=("$(printf '%-24s %s' "$name" "$state")")
    echo "${steps[-1]}"
}

# median_ms TABLE FROM TO: prints the median milliseconds of the frames with FROM to TO - 1 pixels; `-` if there are none.
median_ms() {
    [[ -e $1 ]] || { printf -- -; return; }
    awk -F, -v clock="seconds_$clock" -v from="$2" -v to="$3" '
        NR == 1 { for (i = 1; i <= NF; i++) at[$i] = i; next }
        { pixels = $at["width_px"] * $at["height_px"] }
        pixels >= from && pixels < to && $at[clock] != "" { print 1e3 * $at[clock] }' "$1" | sort -g |
        awk '{ t[NR] = $1 } END { if (NR) printf "%.4f", t[int((NR + 1) / 2)]; else printf "-" }'
}

# Side of the images on the path of the step `switches`, pixels.
side=$((max_size / 2))
# The volumes of members that no calibration renders (`entire calibrate` takes m01 and m02).
mapfile -t volumes < <(printf '%s\n' data/*/m*/t*.nrrd | grep -v '/m0[12]/')
step probe 60 probe --device "$device"
for shade in "${shades[@]}"; do
    model=$out/machine-$shade.safetensors
    if [[ ! -e $out/done/calibrate-$shade ]]; then rm -f "$out/calibrate-$shade".{csv,manifest.json}; fi
    step "calibrate-$shade" "$((calibration + 30))" calibrate --shade "$shade" --clock "$clock" --device "$device" \
        --seconds "$calibration" --max-size "$max_size" --out "$model" --table "$out/calibrate-$shade.csv"
    common=(--shade "$shade" --device "$device" --repeats 3 --min-size 32 --max-size "$max_size" --frames "$frames"
        --seed 41 --resume)
    step "frames-$shade" 35 collect "${volumes[@]}" "${common[@]}" --enlarge "$enlarge" --out "$out/frames-$shade.csv"
    # Two large volumes suffice: they take long to load, and differ from the other volumes only in size.
    if ((large)); then
        step "large-$shade" 35 collect "${volumes[@]:0:2}" "${common[@]}" --enlarge "$large" --out "$out/large-$shade.csv"
    fi
    for kind in frames large; do
        if [[ -e $out/$kind-$shade.csv ]]; then
            step "evaluate-$kind-$shade" 60 evaluate --quiet --clock "$clock" --observed 10 --model "$model" \
                --data "$out/$kind-$shade.csv" --out "$out/evaluated-$kind-$shade"
        fi
    done
    # A path with switches of the transfer function. The target is half of the median time of images of a similar size.
    ms=$(median_ms "$out/frames-$shade.csv" "$((side * side / 3))" "$((side * side * 3))")
    if [[ $shade == none && $ms != - ]]; then
        step switches 90 steer "${volumes[0]}" --generate switches --device "$device" --clock "$clock" --model "$model" \
            --enlarge "$enlarge" --size "${side}x$side" --frames 240 --out "$out/switches" \
            --target "$(awk -v ms="$ms" 'BEGIN { print ms / 2e3 }')s"
    fi
done

{
    printf '%s\n' "${steps[@]}"
    printf '\nMedian milliseconds of frames that no calibration rendered, by number of pixels:\n'
    printf '%-8s %-7s %12s %14s %14s\n' shading table "below 128²" "128² to 512²" "512² and more"
    for shade in "${shades[@]}"; do
        for kind in frames large; do
            table=$out/$kind-$shade.csv
            printf '%-8s %-7s %11s %14s %14s\n' "$shade" "$kind" "$(median_ms "$table" 0 16384)" \
                "$(median_ms "$table" 16384 262144)" "$(median_ms "$table" 262144 1e12)"
        done
    done
    for log in "$out"/logs/{probe,evaluate-*,switches}.txt; do
        if [[ -e $log ]]; then printf '\n== %s\n' "$(basename "$log" .txt)" && cat "$log"; fi
    done
} >"$out/report.txt"
echo "Report: $out/report.txt"
((${#steps[@]} == $(printf '%s\n' "${steps[@]}" | grep -cE ' (done|cut short), '))) || exit 1
