# SPDX-License-Identifier: MIT OR Apache-2.0
"""Errors of predictors per renderer: VTK's fixed-point and GPU mappers, ParaView, yt. From the timing tables in
data/timings (RENDERER-train and RENDERER-test, of different volumes; the collectors make such tables) a factor network
is trained, and `entire calibrate` fits unit costs to all and to a twentieth of the training frames. All models are
tested on RENDERER-test. Needs no renderer. bars.py calls this; bars of a missing table are short.

ENTIRE_DATA  folder to which the volume names in the tables are relative (default ../shared/data)
"""
import bisect
import csv
import gzip
import itertools
import json
import math
import os
import shutil
import subprocess

RENDERERS = ("vtk-fixed", "vtk-gpu", "paraview", "yt")
HOW = "--model-kind residual --batch 128 --learning-rate 0.003 --epochs 150".split()
# Inputs of the factor. Some describe waiting for memory and the conversion of stored values, which take these renderers
# longer than the raycaster.
# The factor is the mean of eight networks with different seeds.
MORE = """log_pixels log_samples_per_pixel log_shadow_per_pixel log_segments_per_ray log_ray_spacing footprint_share
terminated_share log_divergence occupied_share log_visible_share log_mean_extinction log_mean_chord log_step log_voxels
log_runs log_skips log_remapped_samples log_far_x log_far_y log_far_z""".split()
FACTOR = [*HOW, "--layers", "32,16", "--ensemble", "8", "--scene-features", ",".join(MORE)]
SHARE = 0.05
ASKED = {name: limit for r in RENDERERS for name, limit in ((f"{r}-rmse-over-sd-on-unseen-volumes", 0.15),
                                                            (f"{r}-transferred-over-fully-trained", 1.2))}


def cut(table, count, out):
    """Writes `count` frames of a table, with all their repeats, into the table `out`, and copies the manifest. Frames
    are sorted by expected cost and taken at even distances of the cumulative sum of the cost's square root, so that
    long frames, which cause most of the error, are chosen more often. The expected cost comes from the features beside
    the table, not from the table's times."""
    with gzip.open(table.removesuffix(".csv.gz") + ".features.csv.gz", "rt", newline="") as file:
        file.readline()
        weights = {row["frame"]: math.sqrt(float(row["estimated_seconds"])) for row in csv.DictReader(file)}
    order = sorted(weights, key=weights.get)
    sums = list(itertools.accumulate(weights[frame] for frame in order))
    at = [bisect.bisect_left(sums, (i + 0.5) / count * sums[-1]) for i in range(count)]
    kept = {order[min(i, len(order) - 1)] for i in at}
    with gzip.open(table, "rt", newline="") as file:
        reader = csv.DictReader(file)
        rows, names = [row for row in reader if row["frame"] in kept], reader.fieldnames
    with gzip.open(out, "wt", newline="") as file:
        writer = csv.DictWriter(file, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    shutil.copyfile(table.removesuffix(".csv.gz") + ".manifest.json", out.removesuffix(".csv.gz") + ".manifest.json")


def run(options, bars):
    tables = os.path.abspath(os.path.join("data", "timings"))
    out = os.path.abspath(options.out)
    volumes = os.environ.get("ENTIRE_DATA", os.path.join("..", "shared", "data"))
    if not os.path.isdir(volumes):
        bars.lacking(f"there is no folder {volumes}: name the one that holds ensembles/ and scans/ with ENTIRE_DATA", ASKED)
        return
    program = os.path.abspath(options.entire)

    log = os.path.join(out, "accuracy.log")

    def entire(*words):
        with open(log, "a") as file:
            done = subprocess.run([program, *map(str, words)], stdout=file, stderr=file, cwd=volumes)
        if done.returncode:
            raise RuntimeError(f"entire {words[0]} failed; see {log}")

    def train(tables, name, *how):
        model = os.path.join(out, f"{name}.safetensors")
        entire("train", "--data", *tables, "--clock", "cpu", "--split", "volume", "--quiet", "--out", model, *how)
        return model

    def calibrated(table, name):
        model = os.path.join(out, f"{name}.safetensors")
        entire("calibrate", "--data", table, "--clock", "cpu", "--quiet", "--out", model)
        return model

    def judge(renderer):
        learn, test = (os.path.join(tables, f"{renderer}-{part}.csv.gz") for part in ("train", "test"))
        with gzip.open(learn, "rt", newline="") as file:
            frames = len({row["frame"] for row in csv.DictReader(file)})
        few = max(8, int(SHARE * frames))
        part = os.path.join(out, f"{renderer}-{few}.csv.gz")
        cut(learn, few, part)
        tuned = f"calibrated with {few}"
        models = {"factor": train([learn], f"{renderer}-factor", *FACTOR),
                  "unit costs": calibrated(learn, f"{renderer}-costs"),
                  tuned: calibrated(part, f"{renderer}-calibrated-{few}")}
        folder = os.path.join(out, f"evaluation-{renderer}")
        entire("evaluate", "--model", *models.values(), "--data", test, "--clock", "cpu", "--quiet", "--out", folder)
        with open(os.path.join(folder, "evaluation.json")) as file:
            result = json.load(file)
        scores = {p["name"]: p["metrics"] for p in result["predictors"]}
        noise = (result.get("noise_floor") or {}).get("log_sd")
        print(f"{renderer}: {frames} frames to learn from; repeats of a frame scatter by "
              + ("an unknown amount" if noise is None else f"{noise:.3f} in ln(time)"))
        value = {}
        for label, path in models.items():
            m = scores[os.path.splitext(os.path.basename(path))[0]]
            value[label] = m["rmse_over_sd"]
            print(f"  {label:20} RMSE/SD {m['rmse_over_sd']:.3f}  median error {100 * m['mdape']:.1f} %")
        bars.found(f"{renderer}-rmse-over-sd-on-unseen-volumes", value["factor"])
        bars.found(f"{renderer}-transferred-over-fully-trained", value[tuned] / value["factor"], tuned)

    with bars.part(*ASKED):
        for renderer in RENDERERS:
            with bars.part(*(name for name in ASKED if name.startswith(f"{renderer}-"))):
                judge(renderer)
