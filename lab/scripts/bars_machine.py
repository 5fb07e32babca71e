#!/usr/bin/env python3
# SPDX-License-Identifier: MIT OR Apache-2.0
"""The bars of a machine's model: `entire calibrate` on this machine, tested on volumes that it did not render.

    bars_machine.py --data FOLDER [--out out/bars-machine] [--seed N] [--only STEP,…] [--no-test] [--steps]

Prints `bar NAME VALUE LIMIT ok|short`, and `interval NAME LOW HIGH` for errors (95 %, by bootstrap over volumes); exit
status 1 when a bar is short or has no value. FOLDER holds ensembles/ and scans/.
Test frames are timed once before the calibration of their shading mode and once after it, and the mean of both times is
used: if the machine's speed changes meanwhile, its mean speed in the tests is about its speed during the calibration.
The test frames are drawn with a seed, by default the date of the first step, so that each run has other frames: a method
that was chosen on the frames of one run is judged on frames that it has not met. --out keeps the seed.
Every step leaves a file in --out and is skipped if that file exists, so that the work can be done in slices of a few
minutes on a quiet machine: --steps lists the steps, --only runs only some. A bar whose steps are not all done is short.
Needs Python 3.9 and `entire` (--bin), and nothing else.
"""
import argparse
import contextlib
import csv
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

from bar_lines import Bars

ROOT = Path(__file__).resolve().parents[2]

# Held-out members, and their time steps.
MEMBERS = ("castro_blast/m04", "castro_blast/m05", "nyx_cosmology/m04", "nyx_cosmology/m05", "maestroex_bubbles/m03")
MEMBER_STEPS = (3, 6, 9, 12)
SCANS = ("ct_abdomen", "ct_bonsai", "ct_engine", "ct_head_stanford", "cta_avm", "mr_angio_head", "mr_icbm152",
         "mr_t1_head", "mr_t2_brain", "uct_iguana", "uct_mouse_skull", "xa_aneurism", "ed_rhodopsin_3pqr")
MODES = ("none", "local", "scatter")
# Frames per volume; a frame with scattering takes several times as long.
FRAMES = {"none": 6, "local": 6, "scatter": 4}
# Limits of median error and RMSE/SD on members, then on scans.
LIMITS = {"none": (0.055, 0.05, 0.065, 0.08), "local": (0.05, 0.05, 0.065, 0.08), "scatter": (0.07, 0.07, 0.065, 0.08)}
SPLITS = ("members", "scans")
CALIBRATION_SECONDS = 90.0
FEW_FRAMES = 20
FEW_LIMIT = 0.10
OBSERVED = 10
BUSY_LIMIT = 0.08
# Number of neighbors during the calibration `busy`, and the program of a neighbor: it takes a core in bursts of 50 to
# 500 ms, with pauses that are a multiple of the burst.
NEIGHBORS = 1
NEIGHBOR = """
import os, random, sys, time
draw, pause, parent = random.Random(int(sys.argv[1])), float(sys.argv[2]), os.getppid()
while os.getppid() == parent:
    burst = draw.uniform(0.05, 0.5)
    end = time.monotonic() + burst
    while time.monotonic() < end:
        pass
    time.sleep(pause * burst)
"""


@contextlib.contextmanager
def neighbors(*seeds, pause=4):
    """Context in which one neighbor per seed loads the machine. `pause`: pause after a burst, divided by the burst; 4 for
    a fifth of the time, 0 for all the time."""
    loops = [subprocess.Popen([sys.executable, "-c", NEIGHBOR, str(seed), str(pause)]) for seed in seeds]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


# The test frames are measured before the calibration and after it.
WHEN = ("before", "after")
INVALID_LIMIT = 0
# Inputs of the counted predictions: frames of the tables, and random inputs, half of them far outside of any scene's.
INPUTS = ("frames", "random-inputs")


def merge(halves, out):
    """Writes one table from tables of the same frames, timed at different times: each timing is a repeat of its
    frame."""
    rows = {}
    for half in halves:
        with open(half, newline="") as file:
            reader = csv.DictReader(file)
            for row in reader:
                rows.setdefault(int(row["frame"]), []).append(row)
    with open(out, "w", newline="") as file:
        writer = csv.DictWriter(file, reader.fieldnames, lineterminator="\n")
        writer.writeheader()
        for frame in sorted(rows):
            for repeat, row in enumerate(rows[frame]):
                writer.writerow({**row, "repeat": repeat})
    manifest = json.loads(halves[0].with_suffix(".manifest.json").read_text())
    manifest["repeats"] = manifest["settings"]["passes"] = len(halves)
    out.with_suffix(".manifest.json").write_text(json.dumps(manifest, indent=1))


class Machine:
    def __init__(self, options, seed=None):
        self.entire = str(Path(options.bin).resolve())
        self.data = Path(options.data).resolve()
        self.out = Path(options.out).resolve()
        self.out.mkdir(parents=True, exist_ok=True)
        self.asked_seed = seed

    def seed(self):
        """Returns the seed of the test frames, which the folder keeps from the first step on."""
        kept = self.out / "seed"
        if not kept.exists():
            if any(self.out.glob("*-before.csv")):
                sys.exit(f"{self.out} has frames of an unknown seed; name another folder by --out, or delete this one")
            kept.write_text(time.strftime("%Y%m%d") if self.asked_seed is None else str(self.asked_seed))
        seed = int(kept.read_text())
        if self.asked_seed not in (None, seed):
            sys.exit(f"{self.out} has frames of seed {seed}; name another folder by --out for seed {self.asked_seed}")
        return seed

    def run(self, *arguments, cwd=ROOT, **kept):
        print("$ entire " + " ".join(map(str, arguments)), file=sys.stderr, flush=True)
        subprocess.run([self.entire, *map(str, arguments)], cwd=cwd, check=True, stdout=sys.stderr, **kept)

    def table(self, split, mode, when):
        """Times random frames of volumes that no calibration renders, before or after the calibration; merges both
        tables once they exist."""
        if split == "members":
            paths = [f"ensembles/{m}/t{t:04}.nrrd" for m in MEMBERS for t in MEMBER_STEPS]
            more = ["--enlarge", 2]
        else:
            paths, more = [f"scans/{s}.nrrd" for s in SCANS], []
        out = self.out / f"{split}-{mode}-{when}.csv"
        # An interrupted collection continues.
        self.run("collect", *paths, "--out", out, "--shade", mode, "--frames", FRAMES[mode], "--repeats", 1, *more,
                 "--seed", self.seed(), "--resume", cwd=self.data)
        (self.out / f"{split}-{mode}-{when}.done").touch()
        halves = [self.out / f"{split}-{mode}-{w}.csv" for w in WHEN]
        if all((self.out / f"{split}-{mode}-{w}.done").exists() for w in WHEN):
            merge(halves, self.out / f"{split}-{mode}.csv")
            self.run("features", "--data", self.out / f"{split}-{mode}.csv", "--probe-sides", "4,7", "--root", self.data)
            (self.out / f"{split}-{mode}.done").touch()

    def calibrate(self, name, mode, *more):
        frames = self.out / f"{name}.csv"
        frames.unlink(missing_ok=True)
        begin = time.monotonic()
        self.run("calibrate", "--shade", mode, "--out", self.out / f"{name}.safetensors", "--table", frames, *more)
        seconds = time.monotonic() - begin
        self.by_clocks(name, mode)
        (self.out / f"{name}.json").write_text(json.dumps({"seconds": seconds, "load": os.getloadavg()}))

    def calibrate_busy(self):
        with neighbors(*range(NEIGHBORS)):
            self.calibrate("busy", "none")

    def by_clocks(self, name, mode):
        """Fits two models to the frames of a calibration: one by processor time, one by wall time."""
        for clock in ("cpu", "wall"):
            self.run("calibrate", "--data", self.out / f"{name}.csv", "--shade", mode, "--clock", clock, "--quiet", "--out",
                     self.out / f"{name}-{clock}.safetensors")

    def evaluate(self, model, split, mode, clock="cpu"):
        """Returns the output of `entire evaluate`, which is kept until model or table change; None if one is
        missing."""
        files = [self.out / f"{model}.safetensors", self.out / f"{split}-{mode}.csv"]
        if not all(f.exists() for f in files) or not (self.out / f"{split}-{mode}.done").exists():
            return None
        into = self.out / f"evaluated-{model}-{split}-{mode}-{clock}"
        found = into / "evaluation.json"
        if not found.exists() or found.stat().st_mtime < max(f.stat().st_mtime for f in files):
            more = ["--observed", OBSERVED] if model == "busy-cpu" else []
            self.run("evaluate", "--clock", clock, "--model", files[0], "--data", files[1], "--out", into, "--quiet",
                     *more, cwd=self.data)
        return json.loads(found.read_text())

    def steps(self):
        steps = {}
        for mode in MODES:
            for when in WHEN:
                if when == WHEN[1]:
                    steps[f"calibrate-{mode}"] = (f"model-{mode}.json", lambda m=mode: self.calibrate(f"model-{m}", m))
                    if mode == "none":
                        steps["calibrate-few"] = ("few.json", lambda: self.calibrate("few", "none", "--frames", FEW_FRAMES))
                for split in SPLITS:
                    name = f"{split}-{mode}-{when}"
                    steps[name] = (f"{name}.done", lambda s=split, m=mode, w=when: self.table(s, m, w))
        steps["calibrate-busy"] = ("busy.json", self.calibrate_busy)
        return steps


def asked():
    """Returns the limit of every bar by name, in the order of `found`."""
    out = {f"{mode}/calibrate-seconds": CALIBRATION_SECONDS for mode in MODES}
    for mode in MODES:
        for split, (error, rmse) in zip(SPLITS, (LIMITS[mode][:2], LIMITS[mode][2:])):
            out |= {f"{mode}/{split}/mdape": error, f"{mode}/{split}/rmse-over-sd": rmse}
    out[f"none/members/mdape-after-{FEW_FRAMES}-frames"] = FEW_LIMIT
    out[f"none/members/mdape-calibrated-busy-{OBSERVED}-observed"] = BUSY_LIMIT
    return out | {f"shipped/predictions-not-positive-of-{inputs}": INVALID_LIMIT for inputs in INPUTS}


def found(machine, test):
    """Yields name, value and interval of every bar; a value or interval that is missing is None."""
    def metrics(found):
        return found["predictors"][0]["metrics"] if found else {}

    def between(found, name):
        """The 95 % interval by bootstrap over volumes."""
        return found["predictors"][0].get(f"{name}_interval") if found else None

    def read(name):
        path = machine.out / f"{name}.json"
        return json.loads(path.read_text()) if path.exists() else {}

    for mode in MODES:
        yield f"{mode}/calibrate-seconds", read(f"model-{mode}").get("seconds"), None
    for mode in MODES:
        for split in SPLITS:
            found = machine.evaluate(f"model-{mode}-cpu", split, mode)
            yield f"{mode}/{split}/mdape", metrics(found).get("mdape"), between(found, "mdape")
            yield f"{mode}/{split}/rmse-over-sd", metrics(found).get("rmse_over_sd"), between(found, "rmse_over_sd")
    found = machine.evaluate("few-cpu", "members", "none")
    yield f"none/members/mdape-after-{FEW_FRAMES}-frames", metrics(found).get("mdape"), between(found, "mdape")
    found = machine.evaluate("busy-cpu", "members", "none")
    in_session = next(iter(found["in_session"].values()), {}) if found else {}
    yield f"none/members/mdape-calibrated-busy-{OBSERVED}-observed", in_session.get("mdape"), None
    for inputs, count in zip(INPUTS, invalid(machine, test)):
        yield f"shipped/predictions-not-positive-of-{inputs}", count, None


def noise(machine, split, mode):
    """Yields, for processor and wall time, the seconds of all frames (mean of the passes), and the median and the ninth
    decile of max / min - 1 over the passes of each frame."""
    path = machine.out / f"{split}-{mode}.csv"
    if not path.exists():
        return
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    for clock in ("cpu", "wall"):
        seconds = {}
        for row in rows:
            seconds.setdefault(row["frame"], []).append(float(row[f"seconds_{clock}"]))
        apart = sorted(max(s) / min(s) - 1 for s in seconds.values())
        whole = sum(sum(s) / len(s) for s in seconds.values())
        yield clock, whole, apart[len(apart) // 2], apart[len(apart) * 9 // 10]


def invalid(machine, test):
    """Returns the numbers of predictions that are not positive, over all shipped models: of the tables' frames, and of
    random inputs. A test counts them, and the counts are kept until models or code change. Two None if the test gives
    no counts, or if `test` is false and there are no kept counts."""
    kept = machine.out / "predictions.json"
    counted = [*ROOT.glob("models/*.safetensors"), *ROOT.glob("core/src/**/*.rs"), *ROOT.glob("steer/src/**/*.rs"), *ROOT.glob("cli/tests/**/predictions.rs")]
    if not kept.exists() or kept.stat().st_mtime < max(f.stat().st_mtime for f in counted):
        if not test:
            return None, None
        cargo = os.environ.get("CARGO", "cargo")
        # The test is selected by its name; if no test has this name, the counts are missing.
        test = ["--test", "*", "no_more_predictions_than_are_known_had_to_be_made_positive", "--", "--nocapture"]
        done = subprocess.run([cargo, "test", "--quiet", "--package", "entire-cli", *test], cwd=ROOT, stdout=subprocess.PIPE,
                              text=True)
        lines = [line.split(":")[1].split() for line in done.stdout.splitlines() if "predictions not positive:" in line]
        counts = [int(number) for number in lines[0]] if lines else []
        # If the test fails with counts of zero, it ended before it counted all predictions.
        if not counts or done.returncode and not any(counts):
            return None, None
        kept.write_text(json.dumps(counts))
    return json.loads(kept.read_text())


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", default=os.environ.get("DATA", ""), help="the folder that holds ensembles/ and scans/")
    parser.add_argument("--out", default="out/bars-machine")
    parser.add_argument("--bin", default="target/release/entire")
    parser.add_argument("--seed", type=int, help="seed of the test frames; default: today's date, YYYYMMDD")
    parser.add_argument("--only", default="", help="run these steps only, comma-separated")
    parser.add_argument("--no-test", action="store_true", help="leave out the bar that builds and runs a test")
    parser.add_argument("--steps", action="store_true", help="list the steps and whether each is done")
    options = parser.parse_args()
    machine = Machine(options, options.seed)
    steps = machine.steps()
    if options.steps:
        for name, (stamp, _) in steps.items():
            print(f"{name:<23}{'done' if (machine.out / stamp).exists() else '-'}")
        return
    wanted = [s for s in options.only.split(",") if s] or list(steps)
    unknown = [s for s in wanted if s not in steps]
    if unknown:
        parser.error(f"no step {', '.join(unknown)}; there are {', '.join(steps)}")
    with Bars(asked()) as bars:
        if not options.data or not Path(options.data, "ensembles").is_dir():
            why = f"{options.data} holds no ensembles/" if options.data else "the volumes' folder is not named"
            sys.exit(f"{why}: make bars-machine DATA=FOLDER-WITH-ensembles-AND-scans")
        if not shutil.which(options.bin):
            sys.exit(f"{options.bin} is not there; build it with `make build`, or name it with --bin")
        try:
            for stamp, make in (steps[name] for name in wanted):
                if not (machine.out / stamp).exists():
                    make()
        except (OSError, subprocess.SubprocessError) as error:
            # Finished steps still give some bars.
            print(error, file=sys.stderr)
        print(f"test frames of seed {machine.seed()}", flush=True)
        for name, value, interval in found(machine, not options.no_test):
            if value is not None:
                bars.found(name, value)
            if interval:
                print(f"interval {name} {interval[0]:.4g} {interval[1]:.4g}", flush=True)
        for mode in MODES:
            for clock, whole, median, decile in noise(machine, "members", mode):
                print(f"passes {mode}/members {clock} take {whole:.1f} s, differ by {median:.1%} (median), {decile:.1%} (ninth decile)")
        undone = [name for name, (stamp, _) in steps.items() if not (machine.out / stamp).exists()]
        why = f"steps are not done: {', '.join(undone)}" if undone else "a test or an evaluation gave no value"
        bars.lacking(f"{why}; run the same command again to continue")


if __name__ == "__main__":
    main()
