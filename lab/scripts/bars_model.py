#!/usr/bin/env python3
# SPDX-License-Identifier: MIT OR Apache-2.0
"""The bars of predictors and of their calibration to a machine, by processor time and by wall time.

    bars_model.py [--study out/study] [--wall out/study-wall] [--frames out/frames] [--machine out/bars-machine]
                  [--before REVISION]

Reads the results of `entire-lab study` by either clock, of `entire-lab frames`, and of `make bars-machine`, whose steps need
a quiet machine and the ensembles. Prints `bar NAME VALUE LIMIT ok|short`; exit status 1 when a bar is short or has no
value. Needs Python 3.9 and git, and nothing else.
"""
import argparse
import csv
import json
import math
import os
import subprocess
from pathlib import Path

from bar_lines import Bars
from bars_machine import CALIBRATION_SECONDS, INPUTS, LIMITS, MODES, SPLITS, Machine, invalid, noise

ROOT = Path(__file__).resolve().parents[2]
UNSHADED = ("unshaded", "unshaded epyc", "unshaded xeon")
# By set (or group of sets) and split: limits of median error and RMSE/SD.
STUDY = {
    "unshaded/members": (0.058, 0.055), "unshaded/scans": (0.07, 0.08), "unshaded/other-codes": (0.07, 0.07),
    "local/members": (0.06, 0.046), "local/scans": (0.07, 0.075),
    "scatter/members": (0.07, 0.05), "scatter/scans": (0.085, 0.055),
}
STUDIED = {"members": "member", "scans": "modality", "other-codes": "other codes"}
NUMBERS = {"unshaded": 20, "local": 20, "scatter": 400}
FRAMES = {3: 0.14, 10: 0.09, 20: 0.075, 160: 0.06, 500: 0.055}
# By wall time, the limits of members are those of processor time times WALL. The limit of the median error is NOISE
# times the difference between the passes (median over the test frames) if that is larger.
WALL, NOISE = 1.3, 1.5
PLAN = {"warm": 4.0, "cold": 6.0}
LINES_OUT = 5000


def asked():
    out = {}
    for clock in ("cpu", "wall"):
        for name, (error, rmse) in STUDY.items():
            out |= {f"{name}/{clock}/mdape": error, f"{name}/{clock}/rmse-over-sd": rmse}
        for count, limit in FRAMES.items():
            out[f"another-make/{clock}/mdape-of-{count}-frames"] = limit
        for mode, limits in LIMITS.items():
            for split, (error, rmse) in zip(SPLITS, (limits[:2], limits[2:])):
                factor = WALL if (clock, split) == ("wall", "members") else 1.0
                out |= {f"here/{mode}/{split}/{clock}/mdape": factor * error,
                        f"here/{mode}/{split}/{clock}/rmse-over-sd": factor * rmse}
    out |= {f"here/{mode}/calibrate-seconds": CALIBRATION_SECONDS for mode in MODES}
    out["here/none/members/wall/busy-over-quiet"] = 1.25
    out |= {f"plan-{caches}-microseconds": limit for caches, limit in PLAN.items()}
    out |= {f"{name}/fitted-numbers": limit for name, limit in NUMBERS.items()}
    out |= {f"predictions-not-positive-of-{inputs}": 0 for inputs in INPUTS}
    return out | {"lines-taken-out": LINES_OUT}


def mean(values):
    """The geometric mean; None if a value is missing."""
    return None if None in values or not values else math.exp(sum(map(math.log, values)) / len(values))


class Study:
    """Results of a study for the predictors that the rule selects."""

    def __init__(self, folder):
        path = Path(folder) / "study.json"
        self.found = json.loads(path.read_text())["findings"] if path.is_file() else None

    def result(self, name, split):
        """Returns median error and RMSE/SD of a set's selected predictor on a split; (None, None) without a result."""
        selected = (self.found or {}).get("selected", {}).get(name)
        for r in (self.found or {}).get("results", ()):
            if (r["set"], r["split"], r["predictor"]) == (name, split, selected):
                return r["metrics"]["mdape"], r["metrics"]["rmse_over_sd"]
        return None, None

    def numbers(self, name):
        selected = (self.found or {}).get("selected", {}).get(name)
        return next((f["numbers"] for f in (self.found or {}).get("fits", ())
                     if (f["set"], f["predictor"]) == (name, selected)), None)


def of_study(bars, clock, study):
    for name in STUDY:
        group, split = name.split("/")
        sets = UNSHADED if name == "unshaded/members" else (group,)
        errors, rmses = zip(*(study.result(s, STUDIED[split]) for s in sets))
        bars.found(f"{name}/{clock}/mdape", mean(errors), f"geometric mean of {len(sets)} machines" if len(sets) > 1 else "")
        bars.found(f"{name}/{clock}/rmse-over-sd", mean(rmses))


def of_frames(bars, clock, path):
    rows = list(csv.DictReader(path.open(newline=""))) if path.is_file() else []
    for count in FRAMES:
        errors = [float(r["median_error"]) for r in rows if int(r["frames"]) == count]
        bars.found(f"another-make/{clock}/mdape-of-{count}-frames", mean(errors) if errors else None)


def of_machine(bars, folder):
    program = ROOT / (os.environ.get("CARGO_TARGET_DIR") or "target") / "release/entire"
    machine = Machine(argparse.Namespace(bin=str(program), data=".", out=folder))

    def metrics(model, split, mode, clock):
        found = machine.evaluate(model, split, mode, clock)
        return found["predictors"][0]["metrics"] if found else {}

    for mode in MODES:
        path = machine.out / f"model-{mode}.json"
        bars.found(f"here/{mode}/calibrate-seconds", json.loads(path.read_text())["seconds"] if path.is_file() else None)
        apart = {clock: median for clock, _, median, _ in noise(machine, "members", mode)}
        for clock, split in ((clock, split) for clock in ("cpu", "wall") for split in SPLITS):
            found = metrics(f"model-{mode}-{clock}", split, mode, clock)
            name = f"here/{mode}/{split}/{clock}"
            limit, note = bars.asked[f"{name}/mdape"], ""
            if (clock, split) == ("wall", "members") and NOISE * apart.get("wall", 0.0) > limit:
                limit, note = NOISE * apart["wall"], f"{NOISE} times the difference between the passes"
            bars.found(f"{name}/mdape", found.get("mdape"), note, limit)
            bars.found(f"{name}/rmse-over-sd", found.get("rmse_over_sd"))
    busy, quiet = (metrics(f"{m}-wall", "members", "none", "wall").get("mdape") for m in ("busy", "model-none"))
    bars.found("here/none/members/wall/busy-over-quiet", busy / quiet if busy and quiet else None)
    for inputs, count in zip(INPUTS, invalid(machine, test=False)):
        bars.found(f"predictions-not-positive-of-{inputs}", count)


def latency(study, caches):
    """Microseconds of a plan's prediction with 11² rays; None if the study did not measure it."""
    latencies = (study.found or {}).get("latencies", ())
    return next((1e6 * l[2][caches] for l in latencies if l[:2] == ["unshaded", "costs (11² rays)"]), None)


def lines(before):
    """Lines of code removed since a revision, minus those added."""
    rooms = ("core", "steer", "io", "train", "farm", "report", "cli", "lab", "plugins")
    done = subprocess.run(["git", "diff", "--numstat", before, "--", *rooms], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    rows = [line.split("\t") for line in done.stdout.splitlines()]
    code = [r for r in rows if r[2].endswith((".rs", ".py", ".cxx", ".h", ".sh"))]
    return sum(int(r[1]) - int(r[0]) for r in code) if done.returncode == 0 and before else None


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--study", default=ROOT / "out/study")
    parser.add_argument("--wall", default=ROOT / "out/study-wall")
    parser.add_argument("--frames", default=ROOT / "out/frames")
    parser.add_argument("--machine", default=ROOT / "out/bars-machine")
    parser.add_argument("--before", default="", metavar="REVISION", help="count the lines of code removed since this revision")
    options = parser.parse_args()
    with Bars(asked(), at_least=("lines-taken-out",)) as bars:
        by_clock = {"cpu": Study(options.study), "wall": Study(options.wall)}
        for clock, study in by_clock.items():
            if study.found is None:
                print(f"there is no study by {clock} time; `make bars-model` runs the study", flush=True)
            of_study(bars, clock, study)
            frames = Path(options.frames) / "frames.csv" if clock == "cpu" else Path(f"{options.frames}-wall") / "frames.csv"
            of_frames(bars, clock, frames)
        of_machine(bars, options.machine)
        for caches in PLAN:
            bars.found(f"plan-{caches}-microseconds", latency(by_clock["cpu"], caches))
        for name in NUMBERS:
            bars.found(f"{name}/fitted-numbers", by_clock["cpu"].numbers(name))
        bars.found("lines-taken-out", lines(options.before), limit=LINES_OUT) if options.before else bars.lacking(
            "name the revision to count from: make bars-model BEFORE=REVISION", ["lines-taken-out"])


if __name__ == "__main__":
    main()
