#!/usr/bin/env bash
# Prints one line `bar NAME VALUE LIMIT ok|short` per goal of robustness and fails when one is short.
#
#   scripts/bars-robust.sh [part...]        parts: mutants kills states vtk miri; default: all
#
# MUTANTS sets how many mutants of model files are tried (100000), FIRST_SEED the first one's seed (0), KILLS and FULL how
# many commands are ended at random moments (200) and on a full disk (20). What a part needs and does not find is said.
set -euo pipefail
cd "$(dirname "$0")/.."

target=$(realpath -m "${CARGO_TARGET_DIR:-target}")
parts=("$@")
if ((${#parts[@]} == 0)); then parts=(mutants kills states vtk miri); fi
short=0

bar() { # name value limit; value at most limit
    local verdict=ok
    if ! awk -v v="$2" -v l="$3" 'BEGIN { exit !(v <= l) }'; then
        verdict=short
        short=1
    fi
    echo "bar $1 $2 $3 $verdict"
}

# Mutants of model files through opening, one prediction, a batch and an encoding, in 4 GB of address space.
mutants() {
    ${CARGO:-cargo} build --release --quiet --package entire-tests --bin model_mutants
    local folder next end aborts=0 panics=0 slowest=0 code line
    folder=$(mktemp -d)
    # The folder's name is put in now: when the trap runs, the variable is gone.
    # shellcheck disable=SC2064
    trap "rm -rf '$folder'" EXIT
    next=${FIRST_SEED:-0}
    end=$((next + ${MUTANTS:-100000}))
    while ((next < end)); do
        code=0
        (
            ulimit -c 0
            ulimit -v $((4 * 1024 * 1024))
            exec "$target/release/model_mutants" "$next" "$end" "$folder/progress"
        ) >"$folder/out" 2>"$folder/err" || code=$?
        line=$(grep '^panics' "$folder/out" || true)
        if ((code == 0)); then
            panics=$((panics + $(awk '{ print $2 }' <<<"$line")))
            slowest=$(awk -v a="$slowest" '{ print ($4 > a) ? $4 : a }' <<<"$line")
            echo "mutants: $line"
            grep '^panic at' "$folder/err" || true
            break
        fi
        # The process ended by itself: the seed that it worked on is to blame, the one after it comes next.
        aborts=$((aborts + 1))
        next=$(awk '{ print $1 }' "$folder/progress")
        echo "mutant with seed $next ended the process (status $code): $(tail -n 1 "$folder/err")"
        next=$((next + 1))
        if ((aborts >= 20)); then
            echo "stopped after 20 of them"
            break
        fi
    done
    bar model_mutants_aborts "$aborts" 0
    bar model_mutants_panics "$panics" 0
    bar model_mutants_slowest_cpu_seconds "$slowest" 1
}

# SIGKILL at random moments and full disks, over every command that writes.
kills() {
    ${CARGO:-cargo} build --release --quiet --package entire-cli --package entire-lab --bins
    python3 lab/scripts/robust/kills.py --entire "$target/release/entire" --lab "$target/release/entire-lab" \
        --kills "${KILLS:-200}" --full "${FULL:-20}" || short=1
}

# Every single-bit flip of saved states, and filters that are not finite.
states() {
    local failed=0
    ${CARGO:-cargo} test --quiet --package entire-core --lib saved_state >/dev/null 2>&1 || failed=1
    bar saved_state_tests_failed "$failed" 0
}

# Re-entrant events of every mapper under the address sanitizer.
vtk() {
    local log failed=0
    log=$(mktemp)
    make --no-print-directory test-vtk-asan >"$log" 2>&1 || failed=1
    # What the step cannot run on this machine it says, and ends well.
    if grep -q '^test-vtk-asan: skipped' "$log"; then
        grep '^test-vtk-asan: skipped' "$log"
    else
        bar vtk_reentry_reports "$failed" 0
        if ((failed)); then tail -n 40 "$log"; fi
    fi
    rm -f "$log"
}

# Undefined behavior in core's scalar kernels and in ffi.
miri() {
    if ! cargo +nightly miri --version >/dev/null 2>&1; then
        echo "miri: skipped: not installed (rustup +nightly component add miri rust-src)"
        return
    fi
    local log failed=0
    log=$(mktemp)
    make --no-print-directory miri >"$log" 2>&1 || failed=1
    grep '^miri: skipped' "$log" || true
    bar miri_reports "$failed" 0
    if ((failed)); then tail -n 40 "$log"; fi
    rm -f "$log"
}

for part in "${parts[@]}"; do "$part"; done
exit "$short"
