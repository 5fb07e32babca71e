#!/usr/bin/env bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# Runs a command that prints bars. If it ends without printing any, for example because it skips, SCRIPT prints the bars
# as short.
#
#   lab/scripts/or_short.sh SCRIPT... -- COMMAND...
#
# SCRIPT is called with --lacking and the reason: the skip reason of the command, or the last line of its output.
set -euo pipefail
script=()
while [[ $1 != -- ]]; do
    script+=("$1")
    shift
done
shift
log=$(mktemp)
trap 'rm -f "$log"' EXIT
status=0
"$@" 2>&1 | tee "$log" || status=$?
if ! grep -q '^bar ' "$log"; then
    why=$(sed -n 's/^.*skipped: //p' "$log" | tail -n 1)
    why=${why:-$(grep -v '^$' "$log" | tail -n 1 || true)}
    "${script[@]}" --lacking "${why:-$1 printed nothing}" || true
    status=1
fi
exit "$status"
