# SPDX-License-Identifier: MIT OR Apache-2.0
"""Every bar of the VTK adapter: the comparison with AutoAdjustSampleDistances, the observer's cost, and the accuracy of
predictions per renderer. Prints `bar NAME VALUE LIMIT ok|short`; exit status 1 when a bar is short or has no value. See
bars.sh.
"""
import argparse
import json
import math
import os
import statistics
import subprocess
import sys

HERE = os.path.dirname(os.path.abspath(__file__))
PLUGIN = os.path.normpath(os.path.join(HERE, "..", "..", "..", "plugins", "vtk", "python"))
sys.path[:0] = [os.path.dirname(HERE), PLUGIN]
import accuracy  # noqa: E402
from bar_lines import Bars  # noqa: E402

# Limits of a mapper's bars: for steering with a calibrated model, and for steering without a model (cold). Of the image
# errors, the first is divided by AutoAdjust's at the same mean time, the second by that of steering without a model.
TARGETS = {"off-target": (0.10, 0.15), "off-target-frames-over-target": (0.10, 0.15), "share-over-1.25x": (0.02, 0.02),
           "frames-until-recovered": (1, 1), "image-error-of-auto-adjust-at-its-mean-time": (0.9, 0.9), "image-error-over-cold": (1.02, None),
           "observer-us": (40, 40)}

# Limit of the observer's time divided by that of an earlier version.
OBSERVER_OVER_BEFORE = 0.6


def asked(mapper):
    """Limits by name."""
    return {
        f"{mapper}-{name}-{what}": pair[i]
        for i, name in enumerate(("calibrated", "cold"))
        for what, pair in TARGETS.items()
        if pair[i] is not None
    }


def python(*words, **options):
    subprocess.run([sys.executable, *map(str, words)], check=True, **options)


def logged(path, *words):
    """Runs a program whose output goes to a file; an error names the file."""
    with open(path, "w") as log:
        done = subprocess.run([*map(str, words)], stdout=log, stderr=log)
    if done.returncode:
        raise RuntimeError(f"{words[0]} failed; see {path}")


def median(repeats, pick):
    """The median over repeats; None where one of them has no value."""
    values = [pick(r) for r in repeats]
    return None if None in values else statistics.median(values)


# Seeds of the noise volumes for the calibration, which the comparison does not draw.
OTHERS = (19, 31)


def comparison_folder(options):
    """Makes the folder of the comparison's files, and returns its path. Frame times differ between versions of VTK, so
    each version has a folder of its own."""
    from vtkmodules.vtkCommonCore import vtkVersion

    folder = os.path.join(options.out, vtkVersion.GetVTKVersion())
    os.makedirs(folder, exist_ok=True)
    return folder


def calibrate(options, out, mapper):
    """Fits a model of this mapper to 60 random frames and to pictures, both of volumes that the comparison does not
    draw; returns its file."""
    import vtk_scene
    from timing_table import write_nrrd

    volumes = []
    for seed in OTHERS:
        # All versions of VTK draw the same files.
        volumes.append(os.path.join(options.out, f"noise-{seed}.nrrd"))
        if not os.path.exists(volumes[-1]):
            write_nrrd(volumes[-1], vtk_scene.noise_volume(256, seed))
    table = os.path.join(out, f"others-{mapper}.csv")
    pictures = os.path.join(out, f"pictures-{mapper}.csv")
    model = os.path.join(out, f"others-{mapper}.safetensors")
    if not (os.path.exists(table) and os.path.exists(pictures)):
        part = os.path.join(out, f"part-{mapper}.csv")
        for left in (part, pictures):
            if os.path.exists(left):
                os.remove(left)
        logged(os.path.join(out, f"collect-{mapper}.log"), sys.executable, os.path.join(PLUGIN, "collect_vtk.py"),
               "--mapper", mapper, "--out", part, "--frames", 60 // len(OTHERS), "--repeats", 2, "--min-size", 96,
               "--max-size", 512, "--steps", "1,1.4,2,3,4", "--pictures", pictures, *volumes)
        # The manifest, which names the mapper, is renamed with its table.
        os.replace(part.replace(".csv", ".manifest.json"), table.replace(".csv", ".manifest.json"))
        os.replace(part, table)
    logged(os.path.join(out, f"calibrate-{mapper}.log"), options.entire, "calibrate", "--data", table, "--clock", "cpu",
           "--pictures", pictures, "--quiet", "--out", model)
    return model


def compare(options, out, mapper):
    model = calibrate(options, out, mapper)
    python(os.path.join(HERE, "compare.py"), "--mapper", mapper, "--out", out, "--model", model,
           "--repeats", options.repeats, "--frames", options.frames)


def comparison_bars(out, bars, mapper):
    with open(os.path.join(out, f"{mapper}.json")) as file:
        repeats = json.load(file)["repeats"]
    for name in ("calibrated", "cold"):
        values = {"off-target": median(repeats, lambda r: r[name]["cpu"]["off"]),
                  "off-target-frames-over-target": median(repeats, lambda r: r[name]["cpu"]["off_hard"]),
                  "share-over-1.25x": median(repeats, lambda r: r[name]["cpu"]["over"]),
                  "frames-until-recovered": median(repeats, lambda r: max(r[name]["cpu"]["recovery"])),
                  "image-error-of-auto-adjust-at-its-mean-time": relative_error(repeats, name),
                  "observer-us": median(repeats, lambda r: r[name]["observer_us"])}
        if name == "calibrated":
            values["image-error-over-cold"] = (
                median(repeats, lambda r: r["calibrated"]["wall"]["error"]) / median(repeats, lambda r: r["cold"]["wall"]["error"])
            )
        for what, value in values.items():
            if value is None:
                bars.lacking("the mean frame time is out of the range of AutoAdjust's three rates", [f"{mapper}-{name}-{what}"])
            else:
                bars.found(f"{mapper}-{name}-{what}", value)


def relative_error(repeats, name):
    """Returns the image error divided by AutoAdjust's error at the same mean frame time by wall time; all values are
    means over the repeats. AutoAdjust's error follows from a power law, fitted to its three rates by least squares in
    logarithms. The law is extrapolated by at most a tenth beyond the longest and the shortest time; None beyond
    that."""
    def mean(who):
        return tuple(statistics.fmean(r[who]["wall"][what] for r in repeats) for what in ("mean_ms", "error"))

    at, error = mean(name)
    points = [mean(who) for who in ("auto", "between", "scaled")]
    times = [time for time, _ in points]
    if not (0.9 * min(times) <= at <= 1.1 * max(times)) or min(e for _, e in points) <= 0:
        return None
    slope, intercept = statistics.linear_regression(*([math.log(p[k]) for p in points] for k in (0, 1)))
    return error / math.exp(intercept + slope * math.log(at))


def observers(options, out, bars, mapper):
    """Prints the observer's time divided by that of an earlier version. Processes of both versions alternate, since one
    process cannot load both."""
    medians = {"today": [], "before": []}
    for turn in range(2 * options.repeats):
        side = ("today", "before", "before", "today")[turn % 4]
        folder = os.path.join(out, f"observer-{side}")
        os.makedirs(folder, exist_ok=True)
        places = {"PYTHONPATH": options.before} if side == "before" else {}
        python(os.path.join(HERE, "compare.py"), "--mapper", mapper, "--out", folder, "--contenders", "full,cold",
               "--repeats", 1, "--frames", options.frames, env={**os.environ, **places})
        with open(os.path.join(folder, f"{mapper}.json")) as file:
            medians[side].append(json.load(file)["repeats"][0]["cold"]["observer_us"])
    today, before = (statistics.median(medians[side]) for side in ("today", "before"))
    bars.found(f"{mapper}-observer-over-before", today / before, f"{today:.1f} / {before:.1f} us")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", required=True)
    parser.add_argument("--entire", required=True, help="the program")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--parts", default="comparison,accuracy")
    parser.add_argument("--before", metavar="FOLDER",
                        help="folder of an earlier version's Python module entire_vtk; the observer is compared with it")
    parser.add_argument("--mappers", default="fixed,gpu")
    parser.add_argument("--lacking", help="reason why nothing can be measured; all bars are printed as short")
    options = parser.parse_args()
    os.makedirs(options.out, exist_ok=True)
    parts, mappers = options.parts.split(","), options.mappers.split(",")
    limits = {name: limit for mapper in mappers for name, limit in asked(mapper).items()} if "comparison" in parts else {}
    if "observer" in parts:
        limits |= {f"{mapper}-observer-over-before": OBSERVER_OVER_BEFORE for mapper in mappers}
    if "accuracy" in parts:
        limits |= accuracy.ASKED
    with Bars(limits) as bars:
        if options.lacking:
            sys.exit(options.lacking)
        if "comparison" in parts:
            for mapper in mappers:
                with bars.part(*asked(mapper)):
                    out = comparison_folder(options)
                    compare(options, out, mapper)
                    comparison_bars(out, bars, mapper)
        if "observer" in parts:
            for mapper in mappers:
                with bars.part(f"{mapper}-observer-over-before"):
                    observers(options, comparison_folder(options), bars, mapper)
        if "accuracy" in parts:
            accuracy.run(options, bars)


if __name__ == "__main__":
    main()
