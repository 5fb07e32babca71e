# SPDX-License-Identifier: MIT OR Apache-2.0
"""Every bar of the VTK adapter: the comparison with AutoAdjustSampleDistances, the observer's cost, and the accuracy of
predictions per renderer. Prints `bar NAME VALUE LIMIT ok|short`, exit status 1 where one is short; a value that cannot be
told is `unmeasured`, and short. See bars.sh.
"""
import argparse
import json
import os
import statistics
import subprocess
import sys

HERE = os.path.dirname(os.path.abspath(__file__))
PLUGIN = os.path.normpath(os.path.join(HERE, "..", "..", "..", "plugins", "vtk", "python"))
sys.path.insert(0, HERE)
sys.path.insert(0, PLUGIN)
SHORT = []


def bar(name, value, limit):
    ok = value is not None and value <= limit
    text = "unmeasured" if value is None else f"{value:.4g}"
    print(f"bar {name} {text} {limit:g} {'ok' if ok else 'short'}", flush=True)
    if not ok:
        SHORT.append(name)


def python(*words, **options):
    subprocess.run([sys.executable, *map(str, words)], check=True, **options)


def logged(path, *words):
    """Runs a program whose output goes to a file, which is named where the program fails."""
    with open(path, "w") as log:
        done = subprocess.run([*map(str, words)], stdout=log, stderr=log)
    if done.returncode:
        sys.exit(f"bars: {words[0]} failed; see {path}")


def median(repeats, pick):
    """The median over repeats; None where one of them has no value."""
    values = [pick(r) for r in repeats]
    return None if None in values else statistics.median(values)


def calibrate(options, mapper):
    """A model of this mapper from 60 random frames of the comparison's volume."""
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
        logged(os.path.join(options.out, f"collect-{mapper}.log"), sys.executable, os.path.join(PLUGIN, "collect_vtk.py"),
               "--mapper", mapper, "--out", part, "--frames", 60, "--repeats", 2, "--min-size", 96, "--max-size", 512,
               "--steps", "1,1.4,2,3,4", volume)
        os.replace(part, table)
    logged(os.path.join(options.out, f"train-{mapper}.log"), options.entire, "train", "--data", table, "--clock", "cpu",
           "--model-kind", "analytic", "--quiet", "--out", model)
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
        bar(f"{label} image error / AutoAdjust's at its mean time", relative_error(repeats, name), 1)
        bar(f"{label} observer us", median(repeats, lambda r: r[name]["observer_us"]), 100)


def relative_error(repeats, name):
    """Image error over that of AutoAdjust at the same mean frame time, on the line through its two runs, all as means over the
    repeats. The line is drawn on by a twentieth of the longer time at most; None beyond that."""
    def mean(who):
        return tuple(statistics.fmean(r[who]["cpu"][what] for r in repeats) for what in ("mean_ms", "error"))

    at, error = mean(name)
    (x0, y0), (x1, y1) = sorted((mean("auto"), mean("scaled")))
    if not (x0 <= at <= 1.05 * x1 and x1 > x0):
        return None
    other = y0 + (y1 - y0) * (at - x0) / (x1 - x0)
    return error / other if other > 0 else float("inf")


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
