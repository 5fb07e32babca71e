#!/usr/bin/env bash
# Prints one line `bar NAME VALUE LIMIT ok|short` per goal of robustness and fails when one is short.
#
#   scripts/bars-robust.sh [part...]        parts: mutants; default: all
#
# MUTANTS sets how many mutants of model files are tried (100000), FIRST_SEED the first one's seed (0).
set -euo pipefail
cd "$(dirname "$0")/.."

parts=("$@")
if ((${#parts[@]} == 0)); then parts=(mutants); fi
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
            exec target/release/model_mutants "$next" "$end" "$folder/progress"
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

for part in "${parts[@]}"; do "$part"; done
exit "$short"
