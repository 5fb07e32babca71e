#!/usr/bin/env bash
# Builds all fuzz targets, or those named, and runs each of them for an equal part of SECONDS (default 60).
#
#   fuzz.sh smoke [SECONDS] [TARGET...]   from the committed corpus, always with the same seed, as many targets at once as
#                                         there are processors; new inputs are discarded
#   fuzz.sh keep SECONDS [TARGET...]      with a new seed each time, from the committed corpus and the inputs of earlier runs
#                                         under out/fuzz/TARGET, where new inputs are kept
#
# An input that crashes a target is kept under fuzz/artifacts; the run then fails, after the other targets had their time.
# Without an address sanitizer or a C++ compiler, a test without coverage guidance runs the corpus and mutations of it.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/lib.sh
mode=${1:-smoke} seconds=${2:-60}
shift $(($# < 2 ? $# : 2))

plain() { # plain REASON: skips fuzzing with this reason, and runs the test without coverage guidance instead
    skip fuzz-smoke "coverage-guided fuzzing: $1; the corpus and mutations of it are run without coverage guidance"
    exec cargo test --workspace --features entire-cli/explore --test hostile_files
}

case "$mode" in
    smoke) seed=${FUZZ_SEED:-1} at_once=$(getconf _NPROCESSORS_ONLN) ;;
    keep) seed=${FUZZ_SEED:-$((RANDOM * 32768 + RANDOM + 1))} at_once=1 ;;
    *) echo "fuzz.sh: found word \"$mode\"; use smoke or keep" >&2 && exit 2 ;;
esac
case "$(uname -sm)" in
    "Linux x86_64" | "Linux aarch64" | "Darwin "*) ;;
    *) plain "there is no address sanitizer on $(uname -sm)" ;;
esac
# The build compiles libFuzzer, which is C++.
command -v "${CXX:-c++}" >/dev/null || plain "there is no C++ compiler"

# The sanitizer and coverage flags are unstable; with this setting a stable compiler accepts them. The host is named as the
# target, so that the flags do not apply to build scripts.
export RUSTC_BOOTSTRAP=1 CARGO_INCREMENTAL=0
host=$(rustc -vV | sed -n 's/^host: //p')
coverage=(-Cpasses=sancov-module -Cllvm-args=-sanitizer-coverage-level=4
    -Cllvm-args=-sanitizer-coverage-inline-8bit-counters -Cllvm-args=-sanitizer-coverage-pc-table
    -Cllvm-args=-sanitizer-coverage-trace-compares)
export RUSTFLAGS="${coverage[*]} -Zsanitizer=address -Cdebug-assertions --cfg fuzzing"
known=$(basename -s .rs -a fuzz/src/bin/*.rs | sort)
targets=${*:-$known}
for target in $targets; do
    grep -qx "$target" <<<"$known" || { echo "there is no fuzz target $target; use one of: "$known >&2 && exit 2; }
done
echo "building the fuzz targets"
# Lock file and output stay in fuzz/, which is not part of the workspace.
cargo build --quiet --locked --release --manifest-path fuzz/Cargo.toml --target-dir fuzz/target --target "$host" \
    $(printf -- '--bin %s ' $targets)

each=$((seconds / $(wc -w <<<"$targets")))
((each >= 1)) || each=1

# run TARGET: runs a target and prints its numbers, and the end of its log if it fails.
run() {
    local target=$1 folder log=out/fuzz/$1.log status=0
    echo "==> $target, $each s, seed $seed"
    folder=$([[ $mode == keep ]] && echo "out/fuzz/$target" || mktemp -d)
    mkdir -p "$folder" "fuzz/artifacts/$target" out/fuzz
    if ! "fuzz/target/$host/release/$target" "$folder" "fuzz/corpus/$target" \
        -artifact_prefix="fuzz/artifacts/$target/" -seed="$seed" -max_total_time="$each" -max_len=65536 -timeout=30 \
        -rss_limit_mb=1024 -malloc_limit_mb=256 -print_final_stats=1 -verbosity=0 >"$log" 2>&1; then
        tail -n 40 "$log"
        echo "FAILED: fuzz target $target; the input is under fuzz/artifacts/$target" >&2
        status=1
    fi
    grep -h "number_of_executed_units\|peak_rss_mb" "$log" || true
    [[ $mode == keep ]] || rm -r "$folder"
    return $status
}

# As `run`, but prints at the end and in one piece, since other targets print meanwhile.
run_beside() {
    local said status=0
    said=$(run "$1" 2>&1) || status=1
    printf '%s\n' "$said"
    return $status
}

status=0 started=()
for target in $targets; do
    if ((at_once == 1)); then
        run "$target" || status=1
        continue
    fi
    if ((${#started[@]} == at_once)); then
        wait "${started[0]}" || status=1
        started=("${started[@]:1}")
    fi
    run_beside "$target" &
    started+=($!)
done
for job in ${started[@]+"${started[@]}"}; do wait "$job" || status=1; done
exit $status
