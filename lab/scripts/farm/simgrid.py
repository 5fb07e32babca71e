#!/usr/bin/env python3
"""Compares the farm simulator with SimGrid on list schedules of recorded frames.

    simgrid.py --bin target/release

Needs g++ and SimGrid (Debian: libsimgrid-dev); without them the check is skipped with a message. Fails if a makespan
differs from SimGrid's by more than 0.1 percent."""

import argparse
import csv
import gzip
import json
import os
import random
import shutil
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
ALLOWED = 1e-3
# Cases: copies of the table's tasks, slots, latency in seconds, dispatch time per task in seconds.
CASES = [(1, 4, 0.6, 0.0), (1, 16, 0.0, 0.01), (8, 64, 0.05, 0.002), (8, 64, 0.05, 0.02), (32, 256, 0.02, 0.001)]


def skip(reason):
    print(f"farm simulator against SimGrid: skipped: {reason}", file=sys.stderr)
    if os.environ.get("ENTIRE_SKIPPED"):
        with open(os.environ["ENTIRE_SKIPPED"], "a", encoding="utf-8") as file:
            file.write(f"farm simulator against SimGrid: {reason}\n")
    sys.exit(0)


def recorded(table):
    """Returns the processor seconds of each frame of a table: the median of its repeats."""
    times = {}
    with gzip.open(table, "rt", encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            times.setdefault(row["frame"], []).append(float(row["seconds_cpu"]))
    return [statistics.median(t) for t in times.values()]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--bin", type=Path, default=ROOT / "target/release", help="folder of entire-lab")
    parser.add_argument("--table", type=Path, default=ROOT / "data/timings/none-members.csv.gz")
    parser.add_argument("--scale", type=float, default=20.0, help="factor on the recorded seconds")
    options = parser.parse_args()
    if shutil.which("g++") is None:
        skip("there is no g++ (apt-get install g++)")
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        program = folder / "simgrid"
        probe = subprocess.run(
            ["g++", "-std=c++17", "-E", "-x", "c++", "-", "-o", os.devnull],
            input="#include <simgrid/s4u.hpp>\n", text=True, capture_output=True,
        )
        if probe.returncode != 0:
            skip("SimGrid's headers are not there (apt-get install libsimgrid-dev)")
        source = Path(__file__).with_name("simgrid.cpp")
        subprocess.run(["g++", "-std=c++17", "-O1", source, "-o", program, "-lsimgrid"], check=True)
        draw = random.Random(1)
        tasks = [options.scale * t for t in recorded(options.table)]
        failed = False
        for copies, slots, latency, dispatch in CASES:
            # Tasks are sent longest first, by times with errors of 10 %.
            order = sorted(copies * tasks, key=lambda t: -t * draw.lognormvariate(0.0, 0.1))
            listed, seconds = folder / "tasks.csv", folder / "seconds.txt"
            listed.write_text("predicted_s,measured_s\n" + "".join(f"{t!r},{t!r}\n" for t in order), encoding="utf-8")
            seconds.write_text("".join(f"{t!r}\n" for t in order), encoding="utf-8")
            costs = [str(slots), str(latency), str(dispatch)]
            own = subprocess.run(
                [options.bin / "entire-lab", "farm-simulate", listed, "--arrival", "--overhead", "0", "--slots", costs[0],
                 "--latency", costs[1], "--dispatch", costs[2]],
                check=True, capture_output=True, text=True,
            )
            own = json.loads(own.stdout)["makespan_s"]
            other = subprocess.run([program, seconds, *costs], check=True, capture_output=True, text=True)
            other = float(other.stdout)
            error = own / other - 1
            failed |= abs(error) > ALLOWED
            print(
                f"{len(order)} tasks, {slots} slots, {latency} s latency, {dispatch} s dispatch: "
                f"{own:.4f} s, SimGrid {other:.4f} s ({100 * error:+.4f} %)"
            )
        sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
