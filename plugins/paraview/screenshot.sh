#!/usr/bin/env bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# Takes a picture of the panel while the view is moved. Needs xdotool and imagemagick. Called by run.sh, on a display.
set -euo pipefail
results=$1/screenshot
rm -rf "$results" && mkdir -p "$results"
export HOME=$results/home
export XDG_CONFIG_HOME=$HOME/.config
mkdir -p "$XDG_CONFIG_HOME"
paraview --plugin-search-paths="$(dirname "$ENTIRE_PLUGIN")" --plugins=EntireSteering \
    --script=plugins/paraview/python/show.py >"$results/log" 2>&1 &
client=$!
trap 'kill $client 2>/dev/null || true' EXIT
for _ in $(seq 120); do grep -q "^shown" "$results/log" && break; sleep 1; done
sleep 5
# Closes the welcome window, if there is one.
xdotool search --name "Welcome to ParaView" key Escape 2>/dev/null || true
sleep 2
xdotool mousemove "${BOX_X:-872}" "${BOX_Y:-182}" click 1
sleep 3
xdotool mousemove 560 560 mousedown 1
for i in $(seq 25); do
    xdotool mousemove_relative -- "$((i % 2 ? 6 : 4))" -3
    sleep 0.4
done
import -window root "$results/moving.png"
xdotool mouseup 1
sleep 4
import -window root "$results/still.png"
echo "paraview: $results/moving.png and still.png"
