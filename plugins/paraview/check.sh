#!/usr/bin/env bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# Checks the plugin in every program that loads it. Called by run.sh, on a display; ENTIRE_PLUGIN is the plugin's file.
#   check.sh OUT [--full]      only in pvbatch; with --full also in pvpython, on two ranks, on a server, in the client
set -euo pipefail
. scripts/lib.sh
out=$1 full=${2:-}
results=$out/check
rm -rf "$results" && mkdir -p "$results"
script=plugins/paraview/python/check.py
failed=0

# Error of a process that was told to save a state but does not draw.
unlearned="nothing was learned yet"

# run NAME COMMAND...: runs a check, which must write "passed: NAME" to its file of results, and must not print $unlearned.
run() {
    local name=$1
    shift
    if timeout 300 "$@" >"$results/$name.log" 2>&1 && grep -qs "^passed: $name" "$results/$name.txt" &&
        ! grep -n "$unlearned" "$results/$name.log"; then
        echo "ok    $name ($(grep -c "^ok: " "$results/$name.txt") checks)"
    else
        echo "FAILED $name:"
        tail -n 15 "$results/$name.log"
        failed=1
    fi
}

run pvbatch pvbatch "$script" "$ENTIRE_PLUGIN" "$results" --name pvbatch
if [[ ! $full ]]; then exit $failed; fi
pvpython=$(command -v pvpython || true)
if [[ ! $pvpython && ${PARAVIEW_ROOT:-} && -x $PARAVIEW_ROOT/usr/bin/pvpython ]]; then pvpython=$PARAVIEW_ROOT/usr/bin/pvpython; fi
if [[ $pvpython ]]; then
    run pvpython "$pvpython" "$script" "$ENTIRE_PLUGIN" "$results" --name pvpython
else
    skip "test-paraview, pvpython and pvserver" "the program pvpython is not installed (it is in python3-paraview)"
fi
if command -v mpirun >/dev/null; then
    run two-ranks mpirun -n 2 --oversubscribe pvbatch "$script" "$ENTIRE_PLUGIN" "$results" --name two-ranks
    if [[ $pvpython ]]; then
        mpirun -n 2 --oversubscribe pvserver --server-port=11711 >"$results/server.log" 2>&1 &
        server=$!
        for _ in $(seq 60); do
            grep -q "Accepting connection" "$results/server.log" && break
            sleep 1
        done
        run pvserver "$pvpython" "$script" "$ENTIRE_PLUGIN" "$results" --name pvserver --server localhost:11711
        for _ in $(seq 20); do kill -0 $server 2>/dev/null || break; sleep 0.5; done
        kill $server 2>/dev/null || true
        wait $server 2>/dev/null || true
        if grep -n "$unlearned" "$results/server.log"; then
            echo "FAILED pvserver: a rank of the server that does not save reports an error"
            failed=1
        fi
    fi
else
    skip "test-paraview, two ranks and pvserver" "the program mpirun is not installed (it is in openmpi-bin)"
fi
# The whole output is read before it is searched: a reader of a pipe that ends early would stop nm with SIGPIPE, which
# pipefail reports as a failure.
if ! symbols=$(nm -DC "$ENTIRE_PLUGIN"); then
    echo "FAILED gui: nm cannot list the symbols of $ENTIRE_PLUGIN"
    failed=1
elif ! command -v paraview >/dev/null; then
    skip "test-paraview, gui" "the program paraview is not installed"
elif [[ $symbols != *pqEntireSteeringPanel* ]]; then
    skip "test-paraview, gui" "the plugin was built without its panel (PARAVIEW_PANEL=OFF, or ParaView without Qt)"
elif [[ $symbols == *" QFileDialog::"* ]]; then
    echo "FAILED gui: the panel calls QFileDialog, which shows the client's disk also if a server draws; use pqFileDialog"
    failed=1
else
    bash plugins/paraview/gui.sh "$out" "$results" || failed=1
fi
exit $failed
