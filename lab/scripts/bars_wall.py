#!/usr/bin/env python3
# SPDX-License-Identifier: MIT OR Apache-2.0
"""Measures how well controllers meet a target by wall time, and prints every bar.

Each part is played --runs times. --only names the parts to play; bars of other parts are short.

  quiet, neighbor  `entire demo` plays four volumes on a quiet machine, and while a neighbor (another program) takes a
                   core in bursts of 50 to 500 ms, a fifth of the time. Bars divide our value by the best other
                   controller's (without the fixed step). A value is the median of the runs, averaged over the volumes.
                   Column `alone`: frames that are late although no other program disturbed them (without a bar).
  steady           `entire demo` plays the first volume while the neighbor takes a core all the time. No bars.
  still            `entire steer` plays our controller alone, with the camera, transfer function and target of the first
                   volume's demo at its first frame, beside the neighbor's bursts. Bar: the share of bursts after which
                   the setting is back at the quiet one within two frames. A frame belongs to a burst if the process got
                   clearly less processor time per wall time in it than in the median frame.
  halved           The same scene; from 10 s after the start on, the process is stopped half of the time, about a
                   millisecond at a time (SIGSTOP and SIGCONT, which need no privilege). Bar: number of frames until
                   two in a row take at most 1.1 x target.
  bonsai           `entire steer` plays another scan with a target of 10 ms, on a quiet machine.

Finished runs are not repeated, so that an interrupted command continues.
"""

import argparse
import contextlib
import csv
import json
import os
import signal
import statistics
import subprocess
import sys
import time
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
FIRST = next(iter(VOLUMES))
BONSAI = "scans/ct_bonsai.nrrd"
OURS, OLP = "hybrid", "olp"
RIVALS = ("olp", "last", "larger-of-two", "pid", "algorithm1")
SWITCH_FRAMES = 3
LATE = 0.1
# Name of a figure, and two upper limits of our value divided by the best rival's: on a quiet machine, and beside
# another program.
SHARES = (("late", 0.5, 0.6), ("mean-error", 0.8, 0.9), ("error-at-switches", 0.4, 0.6))
# A further figure, without a bar: no controller can foresee a frame that another program slows.
UNDISTURBED = "late-undisturbed"
PRINTED = (*(key for key, *_ in SHARES), UNDISTURBED)
PSNR_BELOW = {"quiet": 0.3, "neighbor": 0.5}
PSNR_BELOW_QUIET = 2.0
BONSAI_LATE = 0.03

# The neighbor's pause after a burst, divided by the burst, by name of the load.
PAUSES = {"neighbor": 4, "steady": 0}
STILL_FRAMES = 600
# `entire demo` enlarges the first volume by this factor, since it is small.
ENLARGED = 2
# A frame is disturbed if its processor time per wall time is below this share of the median frame's.
DISTURBED = 0.85
# The setting is back if ray step times squared image sample distance is at most this multiple of the quiet one.
NEAR = 1.1
BACK_FRAMES, BACK = 2, 0.9
# Seconds from the start of a run until its speed is halved; shortest time, in seconds, for which the process then runs
# between two stops.
HALVED_AFTER, HALVED_TURN = 10.0, 0.001
# A frame is at half the speed if its processor time per wall time is below this share of the full speed's: the largest
# median of AROUND consecutive frames. The half speed begins at the first such frame for which the median of the AROUND
# frames from it on is below the same value.
AT_HALF, AROUND = 0.75, 30
HELD_FRAMES = 3

PARTS = ("quiet", "neighbor", "steady", "still", "halved", "bonsai")


def frames(folder):
    """Returns by controller the rows of a run's frames.csv."""
    with open(folder / "frames.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    return {name: [r for r in rows if r["controller"] == name] for name in dict.fromkeys(r["controller"] for r in rows)}


def over(row):
    """Returns the frame time's distance from the target, divided by the target."""
    return float(row["seconds"]) / float(row["target_s"]) - 1


def figures(folder):
    """Returns by controller: share of late frames, mean error, mean error at switches, share of frames that are late
    although no other program disturbed them, mean PSNR in dB."""
    out = {}
    for name, own in frames(folder).items():
        near = {int(r["frame"]) + k for r in own if r["switch"] == "1" for k in range(SWITCH_FRAMES)}
        off = [over(r) for r in own]
        at = [abs(e) for e, r in zip(off, own) if int(r["frame"]) in near]
        out[name] = {
            "late": sum(e > LATE for e in off) / len(off),
            "mean-error": statistics.mean(map(abs, off)),
            "error-at-switches": statistics.mean(at) if at else float("nan"),
            UNDISTURBED: sum(e > LATE for e, d in zip(off, disturbed(own)) if not d) / len(off),
            "psnr": statistics.mean(float(r["psnr_db"]) for r in own),
        }
    return out


def busy(row):
    """Returns the processor time per wall time of a frame."""
    return float(row["seconds_cpu"]) / float(row["seconds_wall"])


def disturbed(rows):
    """Returns for each frame of a run True if it got clearly less processor time per wall time than the median frame."""
    usual = statistics.median(map(busy, rows))
    return [busy(r) < DISTURBED * usual for r in rows]


def coarseness(row):
    return float(row["step_ref"]) * float(row["image_sample_distance"]) ** 2


def frames_until_back(rows):
    """Returns for every burst the number of frames after its end that were coarser than the quiet setting. Bursts that
    another one follows within BACK_FRAMES frames do not count, nor does a burst at an end of the path."""
    slowed = disturbed(rows)
    # The setting of a frame was planned after the frames before it.
    calm = [c for i, c in enumerate(map(coarseness, rows)) if i >= 5 and not any(slowed[i - 5 : i + 1])]
    if not calm:
        return []
    most = NEAR * statistics.median(calm)
    out = []
    for end in range(2, len(rows) - BACK_FRAMES):
        if slowed[end - 1] and not any(slowed[end : end + BACK_FRAMES + 1]):
            coarse = (k for k in range(len(rows) - end) if coarseness(rows[end + k]) <= most)
            out.append(next(coarse, len(rows) - end))
    return out


def frames_until_held(rows):
    """Returns the number of frames at half the speed before two in a row that are not late; None if the speed is not
    halved, or is halved too close to an end of the path."""
    shares = [busy(r) for r in rows]
    last = len(rows) - AROUND
    around = [statistics.median(shares[i : i + AROUND]) for i in range(last)]
    slow = AT_HALF * max(around)
    at = next((i for i in range(around.index(max(around)), last) if max(shares[i], around[i]) < slow), last)
    if at == last:
        return None
    late = [over(r) > LATE for r in rows[at:]]
    return next((k for k in range(len(late) - 1) if not late[k] and not late[k + 1]), len(late))


def halve(process):
    """Halves the speed of a running process, HALVED_AFTER seconds after the call, until it ends. Each stop lasts as long
    as the process ran before it, since a busy machine ends the runs late."""
    try:
        process.wait(HALVED_AFTER)
    except subprocess.TimeoutExpired:
        pass
    try:
        while process.poll() is None:
            begin = time.monotonic()
            time.sleep(HALVED_TURN)
            process.send_signal(signal.SIGSTOP)
            time.sleep(time.monotonic() - begin)
            process.send_signal(signal.SIGCONT)
    finally:
        process.send_signal(signal.SIGCONT)


class Machine:
    def __init__(self, options):
        self.entire, self.out, self.runs = Path(options.bin).resolve(), Path(options.out).resolve(), options.runs
        self.data = Path(options.data).resolve() if options.data else None

        # Folder of this machine's model, which is calibrated with other volumes than the played ones. No other program
        # uses this model.
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

    def played(self, name, arguments, load):
        """Runs a command that writes frames.csv, once per run; returns the folders of the runs."""
        folders = [self.out / f"{name}-{load}-{run}" for run in range(self.runs)]
        for run, folder in enumerate(folders):
            if (folder / "frames.csv").exists():
                continue
            command = [str(self.entire), *map(str, arguments), "--clock", "wall", "--quiet", "--out", str(folder)]
            print("$ " + " ".join(["entire", *command[1:]]), file=sys.stderr, flush=True)
            with contextlib.ExitStack() as stack:
                if load in PAUSES:
                    stack.enter_context(neighbors(run, pause=PAUSES[load]))
                process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, env=self.environment)
                if load == "halved":
                    halve(process)
                if process.wait() != 0:
                    raise subprocess.CalledProcessError(process.returncode, command)
        return folders

    def demo(self, name, load):
        """Plays a volume; returns the folders of the runs."""
        return self.played(name, ["demo", self.volume(VOLUMES[name])], load)

    def still(self, load):
        """Plays the first frame of the first volume's demo again and again; returns the rows of every run."""
        demo, path = self.demo(FIRST, "quiet")[0], self.out / "still.json"
        told = json.loads((demo / "path.json").read_text())
        path.write_text(json.dumps({**told, "frames": STILL_FRAMES, "keyframes": told["keyframes"][:1]}))
        target = json.loads((demo / "summary.json").read_text())["target_s"]
        volume = ["steer", self.volume(VOLUMES[FIRST]), "--enlarge", ENLARGED, "--controllers", OURS]
        folders = self.played("still", [*volume, "--path", path, "--target", f"{target}s"], load)
        return [frames(folder)[OURS] for folder in folders]


def medians(folders):
    runs = [figures(folder) for folder in folders]
    return {
        name: {key: statistics.median(run[name][key] for run in runs) for key in runs[0][name]} for name in runs[0]
    }


def asked():
    """Returns the limit of every bar by name."""
    out = {}
    for load in ("quiet", "neighbor"):
        out |= {f"wall/{load}/{key}-of-best-rival": limits[load == "neighbor"] for key, *limits in SHARES}
        out[f"wall/{load}/psnr-below-rival"] = PSNR_BELOW[load]
    return out | {
        "wall/neighbor/psnr-below-quiet": PSNR_BELOW_QUIET,
        "wall/still/back-within-2-frames": BACK,
        "wall/halved/frames-until-held": HELD_FRAMES,
        "wall/bonsai-10ms/late": BONSAI_LATE,
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", default=os.environ.get("DATA", ""), help="the folder that holds scans/")
    parser.add_argument("--out", default="out/bars-wall", help="folder for the runs")
    parser.add_argument("--bin", default="target/release/entire", help="the program")
    parser.add_argument("--runs", type=int, default=5, help="runs of each volume and load")
    parser.add_argument("--only", default=",".join(PARTS), help="parts to play, comma-separated")
    options = parser.parse_args()
    parts = options.only.split(",")
    if unknown := [part for part in parts if part not in PARTS]:
        parser.error(f"no part {', '.join(unknown)}; there are {', '.join(PARTS)}")
    with Bars(asked(), at_least=["wall/still/back-within-2-frames"]) as bars:
        measure(Machine(options), bars, parts)


def row(name, load, controller, shares, psnr):
    print(f"{name:8} {load:9} {controller:13} {' '.join(f'{s:>8}' for s in shares)} {psnr:6.1f}", flush=True)


def best(found, key):
    return max(min(found[rival][key] for rival in RIVALS), 1e-9)


def psnr_below(found, load):
    """Returns the PSNR of the best rival with less than twice our share of late frames, minus ours. OLP is taken if
    there is no such rival, or beside another program."""
    often = 2 * found[OURS]["late"]
    rivals = [r for r in RIVALS if load == "quiet" and found[r]["late"] < often] or [OLP]
    return max(found[r]["psnr"] for r in rivals) - found[OURS]["psnr"]


def measure(machine, bars, parts):
    missing = [path for path in (*VOLUMES.values(), BONSAI) if machine.volume(path) is None]
    machine.calibrate()
    print(f"{'volume':8} {'load':9} {'controller':13} {'> 1.1 T':>8} {'|t-T|/T':>8} {'switches':>8} {'alone':>8} {'PSNR':>6}")
    found = {}
    for load in ("quiet", "neighbor", "steady"):
        for name in VOLUMES if load != "steady" else [FIRST]:
            if load not in parts or not machine.volume(VOLUMES[name]):
                continue
            found[name, load] = all_of = medians(machine.demo(name, load))
            for controller, f in all_of.items():
                row(name, load, controller, [f"{100 * f[k]:.1f} %" for k in PRINTED], f["psnr"])
            shares = [f"{all_of[OURS][k] / best(all_of, k):.2f}" for k in PRINTED]
            row(name, load, "/ best rival", shares, -psnr_below(all_of, load))
    means = {}
    for load in ("quiet", "neighbor"):
        if not all((name, load) in found for name in VOLUMES):
            continue
        of = [found[name, load] for name in VOLUMES]
        means[load] = mean = {c: {k: statistics.mean(f[c][k] for f in of) for k in of[0][c]} for c in of[0]}
        for controller, f in mean.items():
            row("mean", load, controller, [f"{100 * f[k]:.1f} %" for k in PRINTED], f["psnr"])
        for key, _, _ in SHARES:
            bars.found(f"wall/{load}/{key}-of-best-rival", mean[OURS][key] / best(mean, key))
        bars.found(f"wall/{load}/psnr-below-rival", psnr_below(mean, load))
    if len(means) == 2:
        bars.found("wall/neighbor/psnr-below-quiet", means["quiet"][OURS]["psnr"] - means["neighbor"][OURS]["psnr"])
    if "still" in parts:
        with bars.part("wall/still/back-within-2-frames"):
            until = [frames_until_back(rows) for rows in machine.still("neighbor")]
            print("still: frames until back, by burst and run:", *until)
            counted = [k for run in until for k in run]
            back = sum(k <= BACK_FRAMES for k in counted) / len(counted) if counted else None
            bars.found("wall/still/back-within-2-frames", back, f"{len(counted)} bursts")
    if "halved" in parts:
        with bars.part("wall/halved/frames-until-held"):
            held = [frames_until_held(rows) for rows in machine.still("halved")]
            print("halved: frames until held, by run:", *held)
            bars.found("wall/halved/frames-until-held", None if None in held else statistics.median(held))
    if "bonsai" in parts and (bonsai := machine.volume(BONSAI)):
        arguments = ["steer", bonsai, "--generate", "switches", "--target", "10ms", "--controllers", f"{OLP},{OURS}"]
        bars.found("wall/bonsai-10ms/late", medians(machine.played("bonsai", arguments, "quiet"))[OURS]["late"])
    left = [part for part in PARTS if part not in parts]
    why = [f"{', '.join(missing)} missing: make bars-wall DATA=FOLDER-WITH-scans"] if missing else []
    why += [f"--only leaves out {', '.join(left)}"] if left else []
    bars.lacking("; ".join(why) or "no value was found")


if __name__ == "__main__":
    main()
