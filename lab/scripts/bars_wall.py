# SPDX-License-Identifier: MIT OR Apache-2.0
"""Measures how well controllers meet a target by wall time, and prints every bar.

`entire demo` plays each volume --runs times on a quiet machine, and as often while a neighbor (another program) takes a
core in bursts of 50 to 500 ms, a fifth of the time. Medians over the runs are compared. Rivals are the demo's other
controllers, except the fixed step. `entire steer` plays another scan as often, on a quiet machine only, for the bar
`wall/bonsai-10ms/late`. Finished runs are not repeated, so that an interrupted command continues.
"""

import argparse
import csv
import os
import statistics
import subprocess
import sys
from pathlib import Path

from bar_lines import Bars
from bars_machine import neighbors

ROOT = Path(__file__).resolve().parents[2]
# Volumes on which no model was trained. Scans are in the folder of --data.
VOLUMES = {
    "nyx": "data/nyx_cosmology/m04/t0010.nrrd",
    "castro": "data/castro_blast/m04/t0012.nrrd",
    "engine": "scans/ct_engine.nrrd",
    "head": "scans/mr_t1_head.nrrd",
}
BONSAI = "scans/ct_bonsai.nrrd"
OURS, OLP = "hybrid", "olp"
RIVALS = ("olp", "pid", "algorithm1")
SWITCH_FRAMES = 3
LATE = 0.1
# Name of a figure, and two upper limits of our value divided by the best rival's: on a quiet machine, and beside
# another program.
SHARES = (("late", 0.5, 0.6), ("mean-error", 0.8, 0.9), ("error-at-switches", 0.4, 0.6))
PSNR_BELOW = {"quiet": 0.3, "neighbor": 0.5}
PSNR_BELOW_QUIET = 2.0
BONSAI_LATE = 0.03


def figures(folder):
    """Returns by controller: share of late frames, mean error, mean error at switches, mean PSNR in dB."""
    with open(folder / "frames.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    switches = {int(r["frame"]) for r in rows if r["switch"] == "1"}
    near = {s + k for s in switches for k in range(SWITCH_FRAMES)}
    out = {}
    for name in dict.fromkeys(r["controller"] for r in rows):
        own = [r for r in rows if r["controller"] == name]
        off = [float(r["seconds"]) / float(r["target_s"]) - 1 for r in own]
        at = [abs(e) for e, r in zip(off, own) if int(r["frame"]) in near]
        out[name] = {
            "late": sum(e > LATE for e in off) / len(off),
            "mean-error": statistics.mean(map(abs, off)),
            "error-at-switches": statistics.mean(at) if at else float("nan"),
            "psnr": statistics.mean(float(r["psnr_db"]) for r in own),
        }
    return out


class Machine:
    def __init__(self, options):
        self.entire, self.out, self.runs = Path(options.bin).resolve(), Path(options.out).resolve(), options.runs
        self.data = Path(options.data).resolve() if options.data else None

        # Folder of this machine's model, which is calibrated with other volumes than the played ones; only this script
        # uses it.
        self.environment = {**os.environ, "XDG_DATA_HOME": str(self.out / "home")}

    def calibrate(self):
        done = self.out / "calibrated"
        if not done.exists():
            self.out.mkdir(parents=True, exist_ok=True)
            command = [str(self.entire), "calibrate", "--clock", "wall", "--quiet"]
            subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL, env=self.environment)
            done.touch()

    def volume(self, path):
        folder = self.data if path.startswith("scans/") else ROOT
        return folder / path if folder and (folder / path).is_file() else None

    def played(self, name, arguments, busy):
        """Runs a command that writes frames.csv, once per run; returns the figures of every run."""
        out = []
        for run in range(self.runs):
            folder = self.out / f"{name}-{'neighbor' if busy else 'quiet'}-{run}"
            if not (folder / "frames.csv").exists():
                command = [str(self.entire), *map(str, arguments), "--clock", "wall", "--quiet", "--out", str(folder)]
                print("$ " + " ".join(["entire", *command[1:]]), file=sys.stderr, flush=True)
                with neighbors(*([run] if busy else [])):
                    subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL, env=self.environment)
            out.append(figures(folder))
        return out


def medians(runs):
    return {
        name: {key: statistics.median(run[name][key] for run in runs) for key in runs[0][name]} for name in runs[0]
    }


def asked():
    """Returns the limit of every bar by name."""
    out = {}
    for load in ("quiet", "neighbor"):
        out |= {f"wall/{load}/{key}-of-best-rival": limits[load == "neighbor"] for key, *limits in SHARES}
        out[f"wall/{load}/psnr-below-rival"] = PSNR_BELOW[load]
    return out | {"wall/neighbor/psnr-below-quiet": PSNR_BELOW_QUIET, "wall/bonsai-10ms/late": BONSAI_LATE}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", default=os.environ.get("DATA", ""), help="the folder that holds scans/")
    parser.add_argument("--out", default="out/bars-wall", help="folder for the runs")
    parser.add_argument("--bin", default="target/release/entire", help="the program")
    parser.add_argument("--runs", type=int, default=5, help="runs of each volume, and as many with a neighbor")
    options = parser.parse_args()
    with Bars(asked()) as bars:
        measure(Machine(options), bars)


def measure(machine, bars):
    missing = [path for path in (*VOLUMES.values(), BONSAI) if machine.volume(path) is None]
    machine.calibrate()
    print(f"{'volume':8} {'load':9} {'controller':11} {'> 1.1 T':>8} {'|t-T|/T':>8} {'switches':>8} {'PSNR':>6}")
    found = {}
    for busy, load in ((False, "quiet"), (True, "neighbor")):
        for name, path in VOLUMES.items():
            if file := machine.volume(path):
                found[name, load] = medians(machine.played(name, ["demo", file], busy))
                for controller, f in found[name, load].items():
                    shares = " ".join(f"{100 * f[k]:6.1f} %" for k, _, _ in SHARES)
                    print(f"{name:8} {load:9} {controller:11} {shares} {f['psnr']:6.1f}")

    def mean(load, controller, key):
        return statistics.mean(found[name, load][controller][key] for name in VOLUMES)

    if len(found) == 2 * len(VOLUMES):
        for load in ("quiet", "neighbor"):
            for key, _, _ in SHARES:
                best = min(mean(load, rival, key) for rival in RIVALS)
                bars.found(f"wall/{load}/{key}-of-best-rival", mean(load, OURS, key) / max(best, 1e-9))
            often = 2 * mean(load, OURS, "late")
            # PSNR is compared with rivals that have less than twice our share of late frames; with OLP if there are
            # none, or if another program runs.
            rivals = [r for r in RIVALS if load == "quiet" and mean(load, r, "late") < often] or [OLP]
            below = max(mean(load, r, "psnr") for r in rivals) - mean(load, OURS, "psnr")
            bars.found(f"wall/{load}/psnr-below-rival", below)
        bars.found("wall/neighbor/psnr-below-quiet", mean("quiet", OURS, "psnr") - mean("neighbor", OURS, "psnr"))
    if bonsai := machine.volume(BONSAI):
        arguments = ["steer", bonsai, "--generate", "switches", "--target", "10ms", "--controllers", f"{OLP},{OURS}"]
        bars.found("wall/bonsai-10ms/late", medians(machine.played("bonsai", arguments, False))[OURS]["late"])
    bars.lacking(f"{', '.join(missing)} missing: make bars-wall DATA=FOLDER-WITH-scans")


if __name__ == "__main__":
    main()
