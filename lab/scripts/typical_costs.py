#!/usr/bin/env python3
# SPDX-License-Identifier: MIT OR Apache-2.0
"""Computes the typical unit costs of steer/src/features/cost.rs: UnitCosts::SOFTWARE and UnitCosts::GPU.

Usage: python3 lab/scripts/typical_costs.py [--entire target/release/entire]

Takes the unit costs of the shipped models, which `entire-lab study` fitted to the training tables of processors, and
fits unit costs to the tables of a GPU (`entire calibrate --data`). Prints every cost in each model and its geometric
mean, for processors and for the GPU. For processors, each model's costs are first scaled to the same geometric mean, so
that a fast machine has the same weight as a slow one. A cost of one shading mode is the mean over the models of this
mode. A fit starts from the typical costs, and some costs are hardly determined by the frames, so the means differ from
the constants. Needs Python 3.9 and nothing else.
"""
import argparse
import json
import math
import struct
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
MODELS = ["unshaded", "unshaded-epyc", "unshaded-xeon", "local", "local-xeon", "scatter", "scatter-xeon"]
TABLES = ["none-h100-train", "local-h100-train", "scatter-h100-train"]
# Costs of a single shading mode, by mode; all other costs are of every mode.
ONLY = {
    "local": {"local_samples", "far_local_samples"},
    "scatter": {"scatter_samples", "shadow_samples", "lane_shadow_samples", "far_shadow_samples",
                "longest_shadow_samples", "far_longest_shadow_samples"},
}


def stored(model):
    """The unit costs of a model file, by name."""
    data = model.read_bytes()
    (length,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8:8 + length])
    names = json.loads(header["__metadata__"]["entire.scene_features"])

    def numbers(tensor):
        begin, end = header[tensor]["data_offsets"]
        return struct.unpack(f"<{(end - begin) // 4}f", data[8 + length + begin:8 + length + end])

    return dict(zip(["frame", *names], numbers("prednet.0.bias") + numbers("prednet.0.weight")))


def fitted(entire, table, folder):
    """The unit costs that `entire calibrate` fits to a GPU's table, by name."""
    model = folder / f"{table}.safetensors"
    command = [entire, "calibrate", "--data", f"data/timings/{table}.csv.gz", "--shade", table.split("-")[0], "--clock",
               "device", "--quiet", "--out", model]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{table}: {done.stderr}")
    return stored(model)


def mean(values):
    return math.exp(sum(map(math.log, values)) / len(values))


def mode_of(cost):
    return next((mode for mode, costs in ONLY.items() if cost in costs), None)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--entire", default=ROOT / "target/release/entire", type=Path)
    options = parser.parse_args()
    report("SOFTWARE", {name: stored(ROOT / f"models/{name}-selected.safetensors") for name in MODELS})
    with tempfile.TemporaryDirectory() as folder:
        report("GPU", {table: fitted(options.entire.resolve(), table, Path(folder)) for table in TABLES})


def report(kind, costs):
    """Prints the costs of all tables and their means."""
    names = list(dict.fromkeys(name for table in costs.values() for name in table))
    common = [n for n in names if mode_of(n) is None and all(c.get(n, 0.0) > 0.0 for c in costs.values())]
    print(f"{kind}, seconds: " + ", ".join(costs))
    speed = {table: 1.0 for table in costs}
    if kind == "SOFTWARE":
        speeds = {table: mean([found[n] for n in common]) for table, found in costs.items()}
        speed = {table: value / mean(speeds.values()) for table, value in speeds.items()}
    for name in names:
        of_mode = [t for t in costs if mode_of(name) in (None, t.split("-")[0])]
        found = [costs[t].get(name, 0.0) / speed[t] for t in of_mode]
        each = " ".join(f"{costs[t].get(name, 0.0):9.2e}" for t in costs)
        print(f"{name:26} {each}  {mean(found) if min(found) > 0.0 else 0.0:9.2e}")


if __name__ == "__main__":
    main()
