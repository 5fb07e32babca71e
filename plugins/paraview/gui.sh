#!/usr/bin/env bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# Runs check.py inside the graphical client. Called by check.sh.
set -euo pipefail
results=$2
export HOME=$results/home ENTIRE_SCRIPTS=$PWD/plugins/paraview/python
export XDG_CONFIG_HOME=$HOME/.config
rm -f "$results/gui.txt"
mkdir -p "$XDG_CONFIG_HOME/ParaView"
echo '{"GeneralSettings": {"ShowWelcomeDialog": 0}}' >"$XDG_CONFIG_HOME/ParaView/ParaView-UserSettings.json"
ENTIRE_CHECK=$ENTIRE_PLUGIN$'\n'$results$'\n--name\ngui' timeout 300 paraview --plugin-search-paths="$(dirname "$ENTIRE_PLUGIN")" \
    --plugins=EntireSteering --script="$ENTIRE_SCRIPTS/check.py" --exit >"$results/gui.log" 2>&1 &
client=$!
for _ in $(seq 240); do
    if grep -qs "^passed: gui\|^FAILED\|Traceback" "$results/gui.txt" "$results/gui.log" || ! kill -0 $client 2>/dev/null; then break; fi
    sleep 1
done
for _ in $(seq 20); do kill -0 $client 2>/dev/null || break; sleep 1; done
status=0
if kill -0 $client 2>/dev/null; then kill $client; else wait $client || status=$?; fi
if grep -qs "^passed: gui" "$results/gui.txt" && [[ $status == 0 ]]; then
    echo "ok    gui ($(grep -c '^ok: ' "$results/gui.txt") checks)"
else
    echo "FAILED gui (status $status):"
    tail -n 15 "$results/gui.log" "$results/gui.txt"
    exit 1
fi
