# shellcheck shell=bash
# Bars for scripts of the shell; see bar_lines.py. Source it: . lab/scripts/bar_lines.sh

# 1 once a bar is short.
short=0

# bar NAME VALUE LIMIT: what is no number is no value, and short; another may not exceed the limit.
bar() {
    local value=$2 verdict=short
    [[ $value =~ ^-?[0-9]+(\.[0-9]+)?(e[-+]?[0-9]+)?$ ]] || value=-
    if [[ $value != - ]] && awk -v v="$value" -v l="$3" 'BEGIN { exit !(v <= l) }'; then verdict=ok; else short=1; fi
    echo "bar $1 $value $3 $verdict"
}

# lacking WHY (NAME LIMIT)...: bars that cannot be measured; WHY names what is missing and the remedy.
lacking() {
    echo "not measured: $1"
    shift
    while (($#)); do
        bar "$1" - "$2"
        shift 2
    done
}

# tests_in LOG: how many tests passed and failed by the summaries of cargo test in a file, as "PASSED FAILED".
tests_in() {
    awk '/^test result:/ { for (i = 2; i <= NF; i++) { if ($i == "passed;") p += $(i - 1); if ($i == "failed;") f += $(i - 1) } }
        END { print p + 0, f + 0 }' "$1"
}
