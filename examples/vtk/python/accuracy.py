# SPDX-License-Identifier: MIT OR Apache-2.0
"""How well predictions do per renderer: VTK's fixed-point and GPU mappers, ParaView, yt. From the timing tables in
data/timings (RENDERER-train and RENDERER-test, of different volumes; the collectors make such tables) a factor network
and an analytic model are trained and judged on the volumes that they did not see. A network that was trained on the Vulkan
raycaster's frames is then fine-tuned with a twentieth of the frames, validation included. Needs no renderer. Called by bars.py.

ENTIRE_DATA  folder that the tables' volume names start from (default ../shared/data)
"""
import csv
import gzip
import json
import os
import shutil
import subprocess

RENDERERS = ("vtk-fixed", "vtk-gpu", "paraview", "yt")
BASE = ("none-train", "none-steps")
FACTOR = "--model-kind residual --layers 32 --batch 128 --learning-rate 0.003 --epochs 150".split()
ANALYTIC = "--model-kind analytic".split()
TUNE = "--batch 16 --epochs 300 --learning-rate 0.001".split()
SHARE = 0.05


def cut(table, frames, out):
    """The table of every so-manieth frame, so that there are `frames` of them, with all their repeats, from all of the
    table: its volumes stand one after the other. The manifest goes with it."""
    with gzip.open(table, "rt", newline="") as file:
        reader = csv.DictReader(file)
        rows, names = list(reader), reader.fieldnames
    numbers = list(dict.fromkeys(row["frame"] for row in rows))
    kept = {numbers[i * len(numbers) // frames] for i in range(frames)}
    with gzip.open(out, "wt", newline="") as file:
        writer = csv.DictWriter(file, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows(row for row in rows if row["frame"] in kept)
    shutil.copyfile(table.removesuffix(".csv.gz") + ".manifest.json", out.removesuffix(".csv.gz") + ".manifest.json")


def run(options, bar):
    tables = os.path.abspath(os.path.join("data", "timings"))
    out = os.path.abspath(options.out)
    volumes = os.environ.get("ENTIRE_DATA", os.path.join("..", "shared", "data"))
    if not os.path.isdir(volumes):
        print(f"accuracy: skipped: no folder {volumes}; set ENTIRE_DATA")
        return
    program = os.path.abspath(options.entire)

    log = os.path.join(out, "accuracy.log")

    def entire(*words):
        with open(log, "a") as file:
            done = subprocess.run([program, *map(str, words)], stdout=file, stderr=file, cwd=volumes)
        if done.returncode:
            raise SystemExit(f"accuracy: entire {words[0]} failed; see {log}")

    def train(tables, name, *how):
        model = os.path.join(out, f"{name}.safetensors")
        entire("train", "--data", *tables, "--clock", "cpu", "--split", "volume", "--quiet", "--out", model, *how)
        return model

    base = train([os.path.join(tables, f"{n}.csv.gz") for n in BASE], "vulkan", *FACTOR)
    for renderer in RENDERERS:
        learn, test = (os.path.join(tables, f"{renderer}-{part}.csv.gz") for part in ("train", "test"))
        if not (os.path.exists(learn) and os.path.exists(test)):
            print(f"accuracy: {renderer} is left out: no {learn} and {test}")
            continue
        with gzip.open(learn, "rt", newline="") as file:
            frames = len({row["frame"] for row in csv.DictReader(file)})
        few = max(8, int(SHARE * frames))
        part = os.path.join(out, f"{renderer}-{few}.csv.gz")
        cut(learn, few, part)
        tuned = f"tuned with {few}"
        models = {"factor": train([learn], f"{renderer}-factor", *FACTOR),
                  "analytic": train([learn], f"{renderer}-analytic", *ANALYTIC),
                  "vulkan": base,
                  tuned: train([part], f"{renderer}-tuned-{few}", "--fine-tune", base, *TUNE)}
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
            print(f"  {label:16} RMSE/SD {m['rmse_over_sd']:.3f}  MdAPE {100 * m['mdape']:.1f} %")
        bar(f"{renderer} RMSE/SD on unseen volumes", value["factor"], 0.15)
        bar(f"{renderer} Vulkan model {tuned} / fully trained", value[tuned] / value["factor"], 1.2)
