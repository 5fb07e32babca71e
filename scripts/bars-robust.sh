#!/usr/bin/env bash
# Prints one line `bar NAME VALUE LIMIT ok|short` per goal of robustness, and fails if a goal is missed (`short`).
#
#   scripts/bars-robust.sh [part...]        parts: mutants kills states vtk miri; default: all
#
# MUTANTS: number of mutated model files (100000); FIRST_SEED: seed of the first one (0); KILLS: number of commands that are
# killed at random times (200); FULL: number of commands on a full disk (20). With lower numbers, bars are short. They are
# also short if tools are missing (which is printed) or no test ran.
set -euo pipefail
cd "$(dirname "$0")/.."
. lab/scripts/bar_lines.sh

target=$(realpath -m "${CARGO_TARGET_DIR:-target}")
parts=("$@")
if ((${#parts[@]} == 0)); then parts=(mutants kills states vtk miri); fi
log=$(mktemp)
folder=$(mktemp -d)
trap 'rm -rf "$log" "$folder"' EXIT

# Opens mutants of model files, and runs a prediction, a batch and an encoding with each, in 4 GB of address space.
mutants() {
    local asked=(model_mutants_aborts 0 model_mutants_panics 0 model_mutants_slowest_cpu_seconds 1)
    local next end aborts=0 panics=0 slowest=0 code line asked_for=100000
    if ! ${CARGO:-cargo} build --release --quiet --package entire-tests --bin model_mutants; then
        lacking "model_mutants cannot be built" "${asked[@]}"
        return
    fi
    next=${FIRST_SEED:-0}
    end=$((next + ${MUTANTS:-$asked_for}))
    if ((end - next < asked_for)); then
        lacking "$((end - next)) mutants are fewer than the required $asked_for (MUTANTS=$asked_for)" "${asked[@]}"
        return
    fi
    while ((next < end)); do
        code=0
        (
            ulimit -c 0
            ulimit -v $((4 * 1024 * 1024))
            exec "$target/release/model_mutants" "$next" "$end" "$folder/progress"
        ) >"$folder/out" 2>"$folder/err" || code=$?
        line=$(grep '^panics' "$folder/out" || true)
        grep '^panic at' "$folder/err" || true
        if ((code == 0)); then
            if [[ -z $line ]]; then
                lacking "model_mutants printed no counts: $(tail -n 1 "$folder/err")" "${asked[@]}"
                return
            fi
            panics=$((panics + $(awk '{ print $2 }' <<<"$line")))
            slowest=$(awk -v a="$slowest" '{ print ($4 > a) ? $4 : a }' <<<"$line")
            echo "mutants: $line"
            break
        fi
        # The process ended before the last seed: its current seed is the cause, and the run continues with the next seed.
        aborts=$((aborts + 1))
        panics=$((panics + $(grep -c '^panic at' "$folder/err" || true)))
        next=$(awk '{ print $1 }' "$folder/progress" 2>/dev/null || echo "$next")
        echo "mutant with seed $next ended the process (status $code): $(tail -n 1 "$folder/err")"
        # The durations of earlier mutants are unknown.
        slowest=unknown
        next=$((next + 1))
        if ((aborts >= 20)); then
            echo "stopped after 20 mutants that ended the process"
            ((panics > 0)) || panics=unknown
            break
        fi
    done
    bar model_mutants_aborts "$aborts" 0
    bar model_mutants_panics "$panics" 0
    bar model_mutants_slowest_cpu_seconds "$slowest" 1
}

# Counts torn or lost files after commands that write files were killed (SIGKILL) at random times, or ran on a full disk.
kills() {
    ${CARGO:-cargo} build --release --quiet --package entire-cli --package entire-lab --bins || {
        lacking "the commands cannot be built" files_torn_or_lost_kill_200 0 files_torn_or_lost_full_disk_20 0
        return
    }
    python3 lab/scripts/robust/kills.py --entire "$target/release/entire" --lab "$target/release/entire-lab" \
        --kills "${KILLS:-200}" --full "${FULL:-20}" || short=1
}

# Tests every single-bit flip of saved states, and states with filters that are not finite.
states() {
    local passed failed code=0
    ${CARGO:-cargo} test --quiet --package entire-steer --lib saved_state >"$log" 2>&1 || code=$?
    read -r passed failed <<<"$(tests_in "$log")"
    echo "states: $passed tests passed, $failed failed"
    if ((failed == 0 && (passed == 0 || code != 0))); then
        lacking "no test named saved_state ran to its end: $(tail -n 1 "$log")" saved_state_tests_failed 0
    else
        bar saved_state_tests_failed "$failed" 0
    fi
}

# Runs the tests of re-entrant events of every mapper under the address sanitizer.
vtk() {
    local counts why
    make --no-print-directory test-vtk-asan >"$log" 2>&1 || true
    # `make test-vtk-asan` also succeeds if it is skipped on this machine; ctest also succeeds if it finds no test.
    counts=$(sed -n 's/.*tests passed, \([0-9]*\) tests\{0,1\} failed out of \([0-9]*\).*/\1 \2/p' "$log" | tail -n 1)
    why=$(sed -n 's/^test-vtk-asan: skipped: //p' "$log" | tail -n 1)
    if [[ -z $counts || $counts == *" 0" ]]; then
        lacking "${why:-no test of re-entrant events ran: $(tail -n 1 "$log")}" vtk_reentry_reports 0
        return
    fi
    echo "vtk: ${counts#* } tests of re-entrant events, ${counts% *} failed"
    bar vtk_reentry_reports "${counts% *}" 0
    [[ $counts == "0 "* ]] || tail -n 40 "$log"
}

# Searches for undefined behavior in core's scalar kernels and in ffi.
miri() {
    local code=0 part passed failed all=0
    make --no-print-directory miri >"$log" 2>&1 || code=$?
    grep '^miri: skipped' "$log" || true
    if grep -q '^miri: skipped: Miri' "$log" || ! grep -q '^==> core' "$log"; then
        lacking "Miri does not run here (rustup component add --toolchain nightly miri rust-src)" miri_reports 0
        return
    fi
    for part in core ffi; do
        awk -v part="==> $part" '/^==> / { in_part = $0 == part } in_part' "$log" >"$folder/$part"
        read -r passed failed <<<"$(tests_in "$folder/$part")"
        echo "miri: $part: $passed tests passed, $failed failed"
        all=$((all + failed))
        if ((passed + failed == 0)); then code=nothing; fi
    done
    # If no test matches a filter, cargo succeeds.
    grep -q '^test kernels::scalar::' "$folder/core" || code=nothing
    if ((all == 0)) && [[ $code == 0 ]]; then
        bar miri_reports 0 0
    elif ((all > 0)) || grep -q 'error: Undefined Behavior' "$log"; then
        bar miri_reports "$((all > 0 ? all : 1))" 0
        tail -n 40 "$log"
    else
        lacking "not all tests of core's scalar kernels and of ffi ran to their end: $(tail -n 1 "$log")" miri_reports 0
    fi
}

for part in "${parts[@]}"; do
    case $part in
        mutants | kills | states | vtk | miri) "$part" ;;
        *) echo "bars-robust.sh: found part \"$part\"; use mutants, kills, states, vtk or miri" >&2; exit 2 ;;
    esac
done
exit "$short"
