# SPDX-License-Identifier: MIT OR Apache-2.0
"""Shared part of the Python peers: a server that reads lines `NAME BATCH SECONDS` and answers each with `@@{json}`.

usage of a peer: NAME_peer.py FOLDER (that of gen.py); PEER_THREADS is the number of threads.
"""
import gc
import json
import os
import sys
import time

import numpy as np
from safetensors.numpy import load_file

FOLDER = sys.argv[1]
THREADS = int(os.environ.get("PEER_THREADS", "1"))
_inputs = load_file(f"{FOLDER}/inputs.safetensors")


def get_input(name, batch):
    return np.ascontiguousarray(_inputs["vol"] if name.startswith("vol") else _inputs["pred"][:batch])


def weights(name):
    return load_file(f"{FOLDER}/{name}.safetensors")


def measure(call, seconds):
    """Minimum and median nanoseconds per call over the given seconds, after a warm-up, and the sum of the result."""
    y = call()
    # bfloat16 has no type in numpy.
    y = y.float().numpy() if hasattr(y, "float") else np.asarray(y)
    check = float(y.astype(np.float64).sum())
    now = time.perf_counter_ns
    begin, warm = now(), 0
    while warm < 1 or (now() - begin < seconds * 0.15e9 and warm < 2000):
        call()
        warm += 1
    end, times = now() + int(seconds * 1e9), []
    gc.disable()
    while True:
        before = now()
        call()
        after = now()
        times.append(after - before)
        if after > end and len(times) >= 2:
            break
    gc.enable()
    times.sort()
    return {"min": times[0], "med": times[len(times) // 2], "n": len(times), "check": check}


def serve(make):
    """`make(variant, name, batch)` returns a call whose result numpy can sum."""
    cases = {}
    for line in sys.stdin:
        spec, batch, seconds = line.split()
        variant, name = spec.split("/") if "/" in spec else ("", spec)
        key = (variant, name, int(batch))
        try:
            if key not in cases:
                cases[key] = make(*key)
            answer = measure(cases[key], float(seconds))
        except Exception as error:  # noqa: BLE001  (whatever a library raises is the answer)
            answer = {"err": f"{type(error).__name__}: {str(error)[:300]}"}
        print("@@" + json.dumps(answer), flush=True)
