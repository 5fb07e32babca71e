#!/usr/bin/env python3
"""Measures the bars of the probe, of transfer functions and of volume summaries: one line `bar NAME VALUE LIMIT ok|short`
each; exit status 1 when any is short.

usage: bars_probe.py --before REVISION [--rounds N] [--work FOLDER] [--only TEXT]

Builds steer/examples/probe_server twice, from the working tree and from REVISION (in a git worktree under FOLDER). A
revision without this example gets the working tree's calls.rs; another revision is measured by its own example. In each
of N rounds, both programs run every measurement, in random order. The time of a scene is its minimum over all rounds;
the time of a measurement is the mean over its scenes. A ratio is the working tree's time divided by REVISION's.
"""
import argparse
import pathlib
import random
import subprocess

from bar_lines import Bars
from servers import Server

ROOT = pathlib.Path(__file__).resolve().parents[2]
EXAMPLE = "steer/examples/probe_server"
# main.rs of the example for the earlier revision: serves the working tree's calls.rs.
MAIN_BEFORE = """//! The calls of a later version.

mod calls;
mod scene;

fn main() {
    calls::serve(&mut calls::Volumes::default(), &mut |_, _| None);
}
"""
# scene.rs of the example for the earlier revision: makes the timed objects with that revision's functions.
SCENE_BEFORE = """//! Makes the timed objects with that version of the crate.

use entire_steer::control::Session;
use entire_steer::features::{SummaryOptions, VolumeSummary};
use entire_core::scene::{Camera, Frame, Scalars, Shading, VolumeView};

pub(crate) fn volume(scalars: Scalars<'_>, dims: [usize; 3], range: (f32, f32)) -> VolumeView<'_> {
    VolumeView::with_known_range(scalars, dims, range).expect("a volume")
}

pub(crate) fn summary(volume: &VolumeView<'_>) -> VolumeSummary {
    VolumeSummary::new(volume, SummaryOptions::default()).expect("a summary")
}

pub(crate) fn frame(camera: Camera, shading: Shading) -> Frame {
    Frame::new(camera, 1024, 768).expect("a frame").with_shading(shading)
}

pub(crate) fn session(side: usize) -> Session {
    Session::untrained().with_probe_side(side).expect("a side")
}
"""
MODES = ["none", "scatter"]
EDGES = [256, 512, 768]
TYPES = ["u8", "u16", "f32"]
BYTES = 512 * 512 * 512
# FIRST: upper limit of the first call with a new transfer function, in microseconds, by edge of the volume in voxels.
# SPEED: lower limit of the speed of a volume summary, in GB/s, by type of the voxels.
FIRST = {256: 60, 512: 120, 768: 400}
SPEED = {"u8": 2.5, "u16": 3.0, "f32": 3.0}


def asked_for():
    """Returns for each bar its limit and its measurements. In a ratio to REVISION, the first measurement is that of the
    working tree, the second that of REVISION."""
    out = {}
    for mode in MODES:
        warm, cold, fine = (f"plan/{what}/{mode}" for what in ("11/warm", "11/cold", "24/cold"))
        out[f"plan_11_warm_{mode}"] = 0.33, (warm, warm)
        out[f"plan_11_cold_{mode}"] = 0.4, (cold, cold)
        out[f"plan_24_cold_over_11_{mode}"] = 1.0, (fine, cold)
    for edge in EDGES:
        first = f"transfer/{edge}/first"
        out[f"transfer_{edge}_us"] = FIRST[edge], (first,)
        out[f"transfer_{edge}"] = 0.1, (first, first)
    for kind in TYPES:
        out[f"summary_{kind}_gb_per_s"] = SPEED[kind], (f"summary/{kind}", f"read/{kind}")
        out[f"summary_{kind}_two_threads"] = 1.7, (f"summary/{kind}", f"summary2/{kind}")
    return out


BARS = asked_for()


def crate(tree):
    """The crate that has sessions in a tree: older revisions have them in the core."""
    return "steer" if (tree / "steer").exists() else "core"


def build(where, target):
    subprocess.run(
        ["cargo", "build", "--release", "--package", f"entire-{crate(where)}", "--features", "rayon", "--example", "probe_server",
         "--target-dir", target], cwd=where, check=True,
    )


def prepare(revision, work):
    """Checks the revision out into a worktree and returns the worktree's path. Adds the working tree's calls.rs if the
    revision has no example of its own."""
    tree = work / "before"
    commit = subprocess.run(["git", "rev-parse", f"{revision}^{{commit}}"], cwd=ROOT, check=True, capture_output=True,
                            text=True).stdout.strip()
    if not tree.exists():
        subprocess.run(["git", "worktree", "prune"], cwd=ROOT, check=True)
        subprocess.run(["git", "worktree", "add", "--detach", str(tree), commit], cwd=ROOT, check=True)
    subprocess.run(["git", "checkout", "--quiet", "--force", "--detach", commit], cwd=tree, check=True)
    to = tree / crate(tree) / "examples/probe_server"
    own = subprocess.run(["git", "ls-files", "--error-unmatch", str(to / "scene.rs")], cwd=tree, capture_output=True)
    if own.returncode == 0:
        return tree
    to.mkdir(parents=True, exist_ok=True)
    for name, text in ("calls.rs", (ROOT / EXAMPLE / "calls.rs").read_text()), ("scene.rs", SCENE_BEFORE):
        (to / name).write_text(text.replace("entire_steer", f"entire_{crate(tree)}"))
    (to / "main.rs").write_text(MAIN_BEFORE)
    return tree


def seconds_of(server, name):
    """Seconds of each scene or call of a measurement."""
    answer = server.ask(name)
    if "err" in answer:
        raise SystemExit(f"{name}: {answer['err']}")
    return answer["seconds"]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", required=True, help="the revision to compare with")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--work", default=str(ROOT / "target/bars-probe"))
    parser.add_argument("--only", default="", help="run only measurements whose names contain this text")
    options = parser.parse_args()

    plans = [f"plan/{side}/{heat}/{mode}" for side in (11, 24) for heat in ("warm", "cold") for mode in MODES]
    transfers = [f"transfer/{edge}/{what}" for edge in EDGES for what in ("first", "edit", "plan")]
    volumes = [f"{what}/{kind}" for kind in TYPES for what in ("summary", "read")]
    today_only = [f"summary2/{kind}" for kind in TYPES]
    today_only += [f"step/{kind}/{what}" for kind in TYPES for what in ("same", "box")]
    asked = [n for n in plans + transfers + volumes + today_only if options.only in n]
    limits = {name: limit for name, (limit, needs) in BARS.items() if all(n in asked for n in needs)}
    with Bars(limits, {name for name in limits if name.startswith("summary")}) as bars:
        measure(options, asked, today_only, bars)


def measure(options, asked, today_only, bars):
    work = pathlib.Path(options.work).resolve()
    work.mkdir(parents=True, exist_ok=True)
    targets = {side: work / f"{side}-build" for side in ("today", "before")}
    build(ROOT, targets["today"])
    build(prepare(options.before, work), targets["before"])
    best = {}
    servers = {side: Server([target / "release/examples/probe_server"]) for side, target in targets.items()}
    for _ in range(options.rounds):
        for name in asked:
            for side in random.sample(["today", "before"], 2):
                if side == "before" and name in today_only:
                    continue
                seconds = seconds_of(servers[side], name)
                known = best.get((side, name))
                best[side, name] = [min(a, b) for a, b in zip(known, seconds)] if known else seconds

    mean = {key: sum(v) / len(v) for key, v in best.items()}
    for name in asked:
        figures = "  ".join(f"{side} {mean[side, name] * 1e6:10.1f} us" for side in ("today", "before")
                            if (side, name) in mean)
        print(f"{name:24} {figures}")

    for name, (_, needs) in BARS.items():
        if name not in bars.asked:
            continue
        if name.endswith("_us"):
            bars.found(name, mean["today", needs[0]] * 1e6)
        elif name.endswith("_gb_per_s"):
            # The limit is at most 0.7 of the rate at which the bytes are read once.
            own, read = (BYTES / mean["today", n] * 1e-9 for n in needs)
            bars.found(name, own, limit=min(bars.asked[name], 0.7 * read))
        elif name.endswith("_two_threads"):
            bars.found(name, mean["today", needs[0]] / mean["today", needs[1]])
        else:
            bars.found(name, mean["today", needs[0]] / mean["before", needs[1]])


if __name__ == "__main__":
    main()
