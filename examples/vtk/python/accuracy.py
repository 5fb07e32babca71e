# SPDX-License-Identifier: MIT OR Apache-2.0
"""How well predictions do per renderer: VTK's fixed-point and GPU mappers, ParaView, yt. From the timing tables in
data/timings (RENDERER-train and RENDERER-test, of different volumes; the collectors make such tables) a factor network
and an analytic model are trained and judged on the volumes that they did not see. A network that was trained on the Vulkan
raycaster's frames is then fine-tuned with few of the frames. Needs no renderer. Called by bars.py.

ENTIRE_DATA  folder that the tables' volume names start from (default ../shared/data)
"""
import csv
import gzip
import json
import os
import subprocess

RENDERERS = ("vtk-fixed", "vtk-gpu", "paraview", "yt")
BASE = ("none-train", "none-steps")
FACTOR = "--model-kind residual --layers 32 --batch 128 --learning-rate 0.003 --epochs 150".split()
ANALYTIC = "--model-kind analytic".split()
TUNE = "--batch 16 --epochs 300 --learning-rate 0.001".split()
SHARES = (0.01, 0.02, 0.05)


def run(options, bar):
    tables = os.path.abspath(os.path.join("data", "timings"))
    out = os.path.abspath(options.out)
    volumes = os.environ.get("ENTIRE_DATA", os.path.join("..", "shared", "data"))
    if not os.path.isdir(volumes):
        print(f"accuracy: skipped: no folder {volumes}; set ENTIRE_DATA")
        return
    program = os.path.abspath(options.entire)

    def entire(*words):
        subprocess.run([program, *map(str, words)], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=volumes)

    def train(names, name, *how):
        model = os.path.join(out, f"{name}.safetensors")
        data = [os.path.join(tables, f"{n}.csv.gz") for n in names]
        entire("train", "--data", *data, "--clock", "cpu", "--split", "volume", "--quiet", "--out", model, *how)
        return model

    base = train(BASE, "vulkan", *FACTOR)
    for renderer in RENDERERS:
        learn, test = (os.path.join(tables, f"{renderer}-{part}.csv.gz") for part in ("train", "test"))
        if not (os.path.exists(learn) and os.path.exists(test)):
            print(f"accuracy: {renderer} is left out: no {learn} and {test}")
            continue
        with gzip.open(learn, "rt", newline="") as file:
            frames = len({row["frame"] for row in csv.DictReader(file)})
        models = {"factor": train([f"{renderer}-train"], f"{renderer}-factor", *FACTOR),
                  "analytic": train([f"{renderer}-train"], f"{renderer}-analytic", *ANALYTIC),
                  "vulkan": base}
        for share in SHARES:
            few = max(8, int(share * frames))
            models[f"tuned {few}"] = train([f"{renderer}-train"], f"{renderer}-tuned-{few}", "--fine-tune", base,
                                           "--limit", few, *TUNE)
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
            print(f"  {label:12} RMSE/SD {m['rmse_over_sd']:.3f}  MdAPE {100 * m['mdape']:.1f} %")
        bar(f"{renderer} RMSE/SD on unseen volumes", value["factor"], 0.15)
        tuned = min((l for l in value if l.startswith("tuned")), key=value.get)
        bar(f"{renderer} Vulkan model {tuned} / fully trained", value[tuned] / value["factor"], 1.2)
