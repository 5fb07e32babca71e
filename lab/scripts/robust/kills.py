#!/usr/bin/env python3
# SPDX-License-Identifier: MIT OR Apache-2.0
"""Ends commands at random moments (SIGKILL) and on full disks, and searches for torn or lost files.

    python3 lab/scripts/robust/kills.py --entire target/release/entire --lab target/release/entire-lab

`entire calibrate`, `calibrate --data`, `train` and `render` write over the file of an earlier run; afterwards, that file
or the complete new one must be there. `entire collect` and `entire-lab record` start without a file; continued with
--resume, the table or trace must have every frame. A full disk is simulated by a limit on the size of files
(RLIMIT_FSIZE), which needs no privilege: writes beyond it fail as on a full disk. Prints `bar NAME VALUE LIMIT ok|short`;
exit status 1 when a bar is short. A bar is also short if fewer commands were ended than it needs.
"""

import argparse
import csv
import json
import random
import resource
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from bar_lines import Bars  # noqa: E402

# Number of commands to end in each way, and the names of the bars.
ASKED = {"kill": 200, "full_disk": 20}
NAMES = {kind: f"files_torn_or_lost_{kind}_{count}" for kind, count in ASKED.items()}
VOLUMES = ["data/castro_blast/m01/t0008.nrrd", "data/nyx_cosmology/m01/t0005.nrrd"]
TABLE = "data/timings/none-scans.csv.gz"
FRAMES = 12


def png(path):
    data = path.read_bytes()
    return data.startswith(b"\x89PNG\r\n\x1a\n") and data.endswith(b"IEND\xaeB`\x82")


def model(path):
    data = path.read_bytes()
    if len(data) < 8:
        return False
    header = json.loads(data[8 : 8 + struct.unpack("<Q", data[:8])[0]])
    end = max(t["data_offsets"][1] for name, t in header.items() if name != "__metadata__")
    return len(data) == 8 + struct.unpack("<Q", data[:8])[0] + end


def table(path):
    """Pairs of frame number and repeat in a table; None if a row is cut off."""
    text = path.read_text()
    rows = list(csv.reader(text.splitlines()))
    if not text.endswith("\n") or any(len(r) != len(rows[0]) for r in rows):
        return None
    return sorted((int(r[0]), int(r[1])) for r in rows[1:])


class Commands:
    """The commands, each with its output file and the check of that file."""

    def __init__(self, entire, lab, folder):
        self.folder = folder
        quick = ["--device", "cpu"]
        collect = ["collect", *VOLUMES, "--frames", str(FRAMES // 2), "--repeats", "2", "--max-size", "96", *quick]
        train = ["train", "--data", TABLE, "--clock", "cpu"]
        self.all = {
            "collect": ([entire, *collect, "--out", folder / "t.csv"], "t.csv", self.complete_table),
            "collect --passes": ([entire, *collect, "--passes", "2", "--out", folder / "p.csv"], "p.csv", self.complete_passes),
            "render": (
                [entire, "render", VOLUMES[0], "--camera", "20,30,2", "--tf", "0.5,0.1,0.2", "--size", "200x200", *quick,
                 "--out", folder / "r.png"],
                "r.png",
                png,
            ),
            "train": ([entire, *train, "--epochs", "5", "--out", folder / "m.safetensors"], "m.safetensors", model),
            "calibrate": (
                [entire, "calibrate", *VOLUMES, "--frames", str(FRAMES), "--seconds", "10", "--device", "cpu", "--out",
                 folder / "k.safetensors"],
                "k.safetensors",
                model,
            ),
            "calibrate --data": (
                [entire, "calibrate", *train[1:], "--prior", "models/unshaded-selected.safetensors", "--clock", "cpu", "--out",
                 folder / "c.safetensors"],
                "c.safetensors",
                model,
            ),
            "record": (
                [lab, "record", VOLUMES[0], "--generate", "switches", "--frames", str(FRAMES), "--size", "96x96", "--steps", "1,4",
                 "--repeats", "1", *quick, "--out", folder / "trace.json"],
                "trace.json",
                lambda path: len(json.loads(path.read_text())["frames"]) == FRAMES,
            ),
        }

    @staticmethod
    def complete_table(path, repeats=2):
        return table(path) == [(frame, repeat) for frame in range(FRAMES) for repeat in range(repeats)]

    def complete_passes(self, path):
        return self.complete_table(path, 4) and not list(self.folder.glob("p.pass*"))

    def resumes(self, name):
        return name.startswith("collect") or name == "record"


def run(command, seconds=None, file_limit=None):
    """Runs a command; ends it after the given seconds. Returns its status (None if it was ended) and its output."""

    def limit():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (file_limit, file_limit))

    process = subprocess.Popen(
        [str(word) for word in command],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        restore_signals=file_limit is None,
        preexec_fn=limit if file_limit is not None else None,
    )
    try:
        said = process.communicate(timeout=seconds)[1]
        return process.returncode, said
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        return None, ""
    finally:
        process.wait()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--entire", default="target/release/entire")
    parser.add_argument("--lab", default="target/release/entire-lab")
    parser.add_argument("--kills", type=int, default=ASKED["kill"])
    parser.add_argument("--full", type=int, default=ASKED["full_disk"], help="runs on a full disk")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    with Bars({name: 0 for name in NAMES.values()}) as bars:
        measure(options, bars)


def measure(options, bars):
    draw = random.Random(options.seed)
    wrong = {"kill": [], "full_disk": []}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        commands = Commands(options.entire, options.lab, folder)
        took = {}
        good = folder / "good"
        good.mkdir()
        for what, (command, file, whole) in commands.all.items():
            begin = time.monotonic()
            process = subprocess.run([str(w) for w in command], capture_output=True, text=True)
            took[what] = time.monotonic() - begin
            if process.returncode or not whole(folder / file):
                sys.exit(f"{what} fails without being ended: {process.stderr.strip()}")
            shutil.copy(folder / file, good / file)

        def clear(file):
            stem = file.split(".")[0]
            for left in [*folder.glob(f"{stem}.*"), *folder.glob(".*.part")]:
                left.unlink()

        def finish(kind, what, say):
            """Checks that the file of an ended command is complete; a command that can continue is first run to its
            end."""
            command, file, whole = commands.all[what]
            path = folder / file
            try:
                if commands.resumes(what):
                    again, said = run([*command, "--resume"])
                    if again != 0:
                        wrong[kind].append(f"{what} {say}: does not go on: {said.strip()}")
                        return
                if not path.exists() or not whole(path):
                    wrong[kind].append(f"{what} {say}: {file} is torn or lost")
            except (ValueError, KeyError, struct.error) as error:
                wrong[kind].append(f"{what} {say}: {file} is torn: {error}")

        ended = 0
        names = list(commands.all)
        while ended < options.kills:
            what = draw.choice(names)
            command, file, _ = commands.all[what]
            clear(file)
            if not commands.resumes(what):
                shutil.copy(good / file, folder / file)
            # A run that can be continued is ended one to four times.
            resume = []
            for _ in range(draw.randint(1, 4) if commands.resumes(what) else 1):
                after = draw.choice([draw.uniform(0.001, 0.03), draw.uniform(0.01, 1.1 * took[what] + 0.02)])
                status, said = run([*command, *resume], seconds=after)
                ended += status is None
                if status not in (None, 0):
                    wrong["kill"].append(f"{what}: refused to go on: {said.strip()}")
                if commands.resumes(what):
                    resume = ["--resume"]
            finish("kill", what, f"ended after {after:.3f} s")
        for round_ in range(options.full):
            what = names[round_ % len(names)]
            command, file, whole = commands.all[what]
            clear(file)
            size = (good / file).stat().st_size
            if not commands.resumes(what):
                shutil.copy(good / file, folder / file)
            limit = draw.randint(0, size - 1)
            status, said = run(command, file_limit=limit)
            reason = (said.strip().splitlines() or [""])[-1]
            if status != 1 or "cannot write" not in reason or str(folder / file.split(".")[0]) not in reason:
                wrong["full_disk"].append(f"{what}: status {status} (right: 1), or no 'cannot write FILE' in the last line:"
                                          f" {said.strip()!r}")
            finish("full_disk", what, f"with space for {limit} of {size} bytes")
    for kind, count in (("kill", ended), ("full_disk", options.full)):
        for line in wrong[kind]:
            print(line, file=sys.stderr)
        print(f"{kind}: {count} ended commands, {len(wrong[kind])} files torn or lost")
        if wrong[kind] or count >= ASKED[kind]:
            bars.found(NAMES[kind], len(wrong[kind]))
        else:
            bars.lacking(f"{count} ended commands are fewer than the {ASKED[kind]} that the bar needs", [NAMES[kind]])


if __name__ == "__main__":
    main()
