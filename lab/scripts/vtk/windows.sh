#!/usr/bin/env bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# Measures the bars of windows that draw volumes in several passes (plugins/windows), for all adapters. The bar of an
# adapter that cannot run is short.
set -uo pipefail
cd "$(dirname "$0")/../../.."
status=0
measured() { # measured ADAPTER COMMAND...
    local adapter=$1 log
    shift
    log=$(mktemp)
    "$@" plugins/windows/windows.py "$adapter" bars | tee "$log" || status=1
    if ! grep -q '^bar ' "$log"; then
        echo "bar late-frames-$adapter - 2 short"
        status=1
    fi
    rm -f "$log"
}
plugins/python/run.sh wheel >/dev/null || true
measured python plugins/python/run.sh exec test python
measured pyvista plugins/python/run.sh exec test python
measured class plugins/vtk/run.sh exec "${VTK_PYTHON:-/usr/bin/python3}"
exit $status
