#!/usr/bin/env python3
# SPDX-License-Identifier: MIT OR Apache-2.0
"""Errors and latency with the present scene features against an earlier revision: the selected recipe of each, on the same
training frames and times. Prints `bar NAME VALUE LIMIT ok|short`; exit status 1 when one is short.

    bars_probe_study.py --before REVISION --data FOLDER [--work target/bars-probe] [--sets unshaded,local,scatter] [--no-build]

Both versions compute features of the training tables with their own code from the volumes in FOLDER (which holds
ensembles/), and cross-validate their selected predictor by ensemble member; nothing is tested on other frames. Latencies
are those that the study of each version measures, the two in turns.
"""
import argparse
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

from bar_lines import Bars

ROOT = Path(__file__).resolve().parents[2]
TABLES = {"unshaded": "none-train", "local": "local-train", "scatter": "scatter-train"}
# Limits of error and latency over those of the earlier revision.
ERROR_LIMIT = 0.75
LATENCY_LIMIT = 0.5
FRAMES_PER_TRANSFER = 30.0
LATENCY_ROUNDS = 3


def run(*words, **more):
    print("$ " + " ".join(map(str, words)), file=sys.stderr, flush=True)
    subprocess.run([str(w) for w in words], check=True, stdout=sys.stderr, **more)


class Version:
    def __init__(self, name, tree, work, data):
        self.name, self.tree, self.data = name, tree, data
        self.target = work / f"{name}-tools"
        self.work = work / f"{name}-study"
        self.work.mkdir(parents=True, exist_ok=True)

    def build(self):
        run("cargo", "build", "--release", "--package", "entire-cli", "--bin", "entire", "--package", "entire-lab", "--bin",
            "entire-lab", "--target-dir", self.target, cwd=self.tree)

    def tool(self, name):
        return self.target / "release" / name

    def features(self, table):
        """A copy of today's table with this version's features."""
        for ending in (".csv.gz", ".manifest.json"):
            shutil.copy(ROOT / f"data/timings/{table}{ending}", self.work / f"{table}{ending}")
        run(self.tool("entire"), "features", "--data", self.work / f"{table}.csv.gz", "--probe-sides", "4,7", cwd=self.data)

    def study(self, sets):
        """Results of a study with only this version's selected recipe: models are kept, latencies are measured again."""
        out = self.work / "out"
        description = json.loads((self.tree / "data/timings/study.json").read_text())
        selected = next(p for p in description["predictors"] if p["name"] == "selected")
        selected["in_set"] = {k: v for k, v in selected.get("in_set", {}).items() if k in sets}
        tables = {s: [f"{TABLES[s]}.csv.gz"] for s in sets}
        volume, factor = description["latency_volume"]
        mini = {
            "title": "selected", "clock": "cpu", "predictors": [selected],
            "latency_volume": [str((self.tree / "data/timings" / volume).resolve()), factor],
            "sets": [{"name": s, "training": tables[s], "splits": [{"name": "seen", "tables": tables[s], "main": True}]}
                     for s in sets],
        }
        path = self.work / "study.json"
        path.write_text(json.dumps(mini))
        run(self.tool("entire-lab"), "study", "--study", path, "--out", out, "--quiet")
        return json.loads((out / "study.json").read_text())["findings"]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", required=True, help="the revision to compare with")
    parser.add_argument("--data", default=os.environ.get("DATA", ""), help="the folder that holds ensembles/")
    parser.add_argument("--work", default=str(ROOT / "target/bars-probe"))
    parser.add_argument("--sets", default=",".join(TABLES))
    parser.add_argument("--no-build", action="store_true", help="take the programs that were built last")
    parser.add_argument("--build-only", action="store_true", help="build, and measure nothing")
    options = parser.parse_args()
    if options.build_only:
        build(options)
        return
    sets = [s for s in options.sets.split(",") if s]
    asked = {}
    for s in sets:
        asked |= {f"median_error_{s}": ERROR_LIMIT, f"rmse_over_sd_{s}": ERROR_LIMIT, f"selected_cold_{s}": LATENCY_LIMIT}
    with Bars(asked) as bars:
        if not options.data or not Path(options.data, "ensembles").is_dir():
            why = f"{options.data} holds no ensembles/" if options.data else "the volumes' folder is not named"
            sys.exit(f"{why}: make bars-probe DATA=FOLDER-WITH-ensembles")
        measure(build(options), sets, bars)


def build(options):
    """Both versions, built unless --no-build is given."""
    work = Path(options.work).resolve()
    before = work / "before-tree"
    if not options.no_build:
        work.mkdir(parents=True, exist_ok=True)
        commit = subprocess.run(["git", "rev-parse", f"{options.before}^{{commit}}"], cwd=ROOT, check=True,
                                capture_output=True, text=True).stdout.strip()
        if not before.exists():
            run("git", "worktree", "prune", cwd=ROOT)
            run("git", "worktree", "add", "--detach", before, commit, cwd=ROOT)
        run("git", "checkout", "--quiet", "--detach", commit, cwd=before)
    data = Path(options.data).resolve()
    versions = [Version("before", before, work, data), Version("today", ROOT, work, data)]
    if not options.no_build:
        for version in versions:
            version.build()
    return versions


def measure(versions, sets, bars):
    found = {}
    for version in versions:
        for s in sets:
            version.features(TABLES[s])
        found[version.name] = version.study(sets)
    latencies = {}
    for _ in range(LATENCY_ROUNDS):
        for version in versions:
            for s, _, latency in version.study(sets)["latencies"]:
                value = latency["cold"] + latency["transfer"] / FRAMES_PER_TRANSFER
                key = (version.name, s)
                latencies[key] = min(latencies.get(key, value), value)
    for s in sets:
        crossed = {v: next(f["crossed"] for f in found[v]["fits"] if f["set"] == s) for v in found}
        for metric, name in [("mdape", "median_error"), ("rmse_over_sd", "rmse_over_sd")]:
            figures = [crossed[v][metric] for v in ("today", "before")]
            print(f"{s:10} {name:14} today {figures[0]:.4f}  before {figures[1]:.4f}")
            bars.found(f"{name}_{s}", figures[0] / figures[1])
        figures = [latencies[v, s] for v in ("today", "before")]
        print(f"{s:10} cold latency   today {figures[0] * 1e6:.1f} us  before {figures[1] * 1e6:.1f} us")
        bars.found(f"selected_cold_{s}", figures[0] / figures[1])


if __name__ == "__main__":
    main()
