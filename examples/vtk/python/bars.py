# SPDX-License-Identifier: MIT OR Apache-2.0
"""Every bar of the VTK adapter: the comparison with AutoAdjustSampleDistances, the observer's cost, and the accuracy of
predictions per renderer. Prints `bar NAME VALUE LIMIT ok|short`, exit status 1 where one is short. See run.sh.
"""
import argparse
import csv
import glob
import json
import os
import re
import shutil
import statistics
import subprocess
import sys

HERE = os.path.dirname(os.path.abspath(__file__))
sys.path.insert(0, HERE)
SHORT = []


def bar(name, value, limit):
    ok = value <= limit
    print(f"bar {name} {value:.4g} {limit:g} {'ok' if ok else 'short'}", flush=True)
    if not ok:
        SHORT.append(name)


def python(*words, **options):
    subprocess.run([sys.executable, *map(str, words)], check=True, **options)


def median(repeats, pick):
    return statistics.median(pick(r) for r in repeats)


def calibrate(options, mapper):
    """A model of this mapper from 40 random frames of the comparison's volume."""
    import vtk_scene
    from timing_table import write_nrrd

    volume = os.path.join(options.out, "noise.nrrd")
    if not os.path.exists(volume):
        write_nrrd(volume, vtk_scene.noise_volume(256))
    table = os.path.join(options.out, f"calibration-{mapper}.csv")
    model = os.path.join(options.out, f"calibration-{mapper}.safetensors")
    if not os.path.exists(table):
        part = os.path.join(options.out, f"part-{mapper}.csv")
        if os.path.exists(part):
            os.remove(part)
        python(os.path.join(HERE, "collect_vtk.py"), "--mapper", mapper, "--out", part, "--frames", 60, "--repeats", 2,
               "--min-size", 96, "--max-size", 512, "--steps", "1,1.4,2,3,4", volume, stderr=subprocess.DEVNULL)
        os.replace(part, table)
    subprocess.run([options.entire, "train", "--data", table, "--clock", "cpu", "--model-kind", "analytic", "--quiet",
                    "--out", model], check=True, stdout=subprocess.DEVNULL)
    return model


def compare(options, mapper):
    model = calibrate(options, mapper)
    python(os.path.join(HERE, "compare.py"), "--mapper", mapper, "--out", options.out, "--model", model,
           "--repeats", options.repeats, "--frames", options.frames)


def comparison_bars(options, mapper):
    with open(os.path.join(options.out, f"{mapper}.json")) as file:
        repeats = json.load(file)["repeats"]
    for name, limit in (("calibrated", 0.10), ("cold", 0.15)):
        label = f"{mapper} {name}"
        bar(f"{label} |t-target|/target, all frames", median(repeats, lambda r: r[name]["cpu"]["off"]), limit)
        bar(f"{label} |t-target|/target, frames over target", median(repeats, lambda r: r[name]["cpu"]["off_hard"]), limit)
        bar(f"{label} share over 1.25x", median(repeats, lambda r: r[name]["cpu"]["over"]), 0.02)
        bar(f"{label} frames until recovered", median(repeats, lambda r: max(r[name]["cpu"]["recovery"])), 1)
        bar(f"{label} image error / AutoAdjust's at its mean time", median(repeats, lambda r: relative_error(r, name)), 1)
        bar(f"{label} observer us", median(repeats, lambda r: r[name]["observer_us"]), 100)


def relative_error(repeat, name):
    """Image error over that of AutoAdjust at the same mean frame time: on the line through its two runs, or that of the
    nearer one beyond them."""
    at, error = repeat[name]["cpu"]["mean_ms"], repeat[name]["cpu"]["error"]
    points = sorted((repeat[n]["cpu"]["mean_ms"], repeat[n]["cpu"]["error"]) for n in ("auto", "scaled"))
    (x0, y0), (x1, y1) = points
    if at <= x0:
        other = y0
    elif at >= x1:
        other = y1
    else:
        other = y0 + (y1 - y0) * (at - x0) / (x1 - x0)
    return error / other if other > 0 else float("inf")


def evaluate(options, models, table, out):
    subprocess.run([options.entire, "evaluate", "--model", *models, "--data", table, "--clock", "cpu", "--quiet", "--out", out],
                   check=True, stdout=subprocess.DEVNULL)
    with open(os.path.join(out, "evaluation.json")) as file:
        return json.load(file)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", required=True)
    parser.add_argument("--entire", required=True, help="the program")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--only-comparison", action="store_true")
    parser.add_argument("--mappers", default="fixed,gpu")
    options = parser.parse_args()
    os.makedirs(options.out, exist_ok=True)
    mappers = options.mappers.split(",")
    for mapper in mappers:
        compare(options, mapper)
    for mapper in mappers:
        comparison_bars(options, mapper)
    if not options.only_comparison:
        import accuracy

        accuracy.run(options, bar)
    sys.exit(1 if SHORT else 0)


if __name__ == "__main__":
    main()
