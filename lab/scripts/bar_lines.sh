# shellcheck shell=bash
# Bars for scripts of the shell; see bar_lines.py. Source it: . lab/scripts/bar_lines.sh

# 0 while all printed bars are met; 1 after the first short bar.
short=0

# bar NAME VALUE LIMIT: prints a bar. VALUE must not exceed LIMIT; a VALUE that is no number is printed as `-` and short.
bar() {
    local value=$2 verdict=short
    [[ $value =~ ^-?[0-9]+(\.[0-9]+)?(e[-+]?[0-9]+)?$ ]] || value=-
    if [[ $value != - ]] && awk -v v="$value" -v l="$3" 'BEGIN { exit !(v <= l) }'; then verdict=ok; else short=1; fi
    echo "bar $1 $value $3 $verdict"
}

# lacking WHY (NAME LIMIT)...: prints bars that cannot be measured. WHY names the missing thing and the remedy.
lacking() {
    echo "not measured: $1"
    shift
    while (($#)); do
        bar "$1" - "$2"
        shift 2
    done
}

# tests_in LOG: prints the numbers of passed and failed tests in a log of cargo test, as "PASSED FAILED".
tests_in() {
    awk '/^test result:/ { for (i = 2; i <= NF; i++) { if ($i == "passed;") p += $(i - 1); if ($i == "failed;") f += $(i - 1) } }
        END { print p + 0, f + 0 }' "$1"
}
