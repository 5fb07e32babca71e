#!/usr/bin/env python3
# SPDX-License-Identifier: MIT OR Apache-2.0
"""Computes the typical unit costs of steer/src/features/cost.rs: UnitCosts::SOFTWARE and UnitCosts::GPU.

Usage: python3 lab/scripts/typical_costs.py [--entire target/release/entire]

Fits unit costs to each training table of data/timings (`entire train --model-kind analytic`). Prints every cost in each
table and its geometric mean, for processors and for GPUs. For processors, each table's costs are first scaled
to the same geometric mean, so that a fast machine has the same weight as a slow one. A cost of one
shading mode is the mean over the tables of this mode. A fit starts from the typical costs, so the means change by a few
per cent when the constants are replaced by them. Needs Python 3.9 and nothing else.
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
TABLES = {
    "SOFTWARE": ("cpu", ["none-train", "none-epyc-train", "none-xeon-train", "local-train", "scatter-train"]),
    "GPU": ("device", ["none-h100-train", "local-h100-train", "scatter-h100-train"]),
}
# Costs of a single shading mode, by mode; all other costs are of every mode.
ONLY = {
    "local": {"local_samples", "far_local_samples"},
    "scatter": {"scatter_samples", "shadow_samples", "lane_shadow_samples", "far_shadow_samples",
                "longest_shadow_samples", "far_longest_shadow_samples"},
}


def fitted(entire, table, clock, folder):
    """The unit costs that `entire train` fits to a table, by name."""
    model = folder / f"{table}.safetensors"
    command = [entire, "train", "--data", f"data/timings/{table}.csv.gz", "--out", model, "--model-kind", "analytic",
               "--clock", clock, "--quiet"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{table}: {done.stderr}")
    data = model.read_bytes()
    (length,) = struct.unpack("<Q", data[:8])
    metadata = json.loads(data[8:8 + length])["__metadata__"]
    return json.loads(metadata["entire.provenance"])["settings"]["unit_costs_seconds"]


def mean(values):
    return math.exp(sum(map(math.log, values)) / len(values))


def mode_of(cost):
    return next((mode for mode, costs in ONLY.items() if cost in costs), None)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--entire", default=ROOT / "target/release/entire", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for kind, (clock, tables) in TABLES.items():
            costs = {table: fitted(options.entire.resolve(), table, clock, Path(folder)) for table in tables}
            report(kind, costs)


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
