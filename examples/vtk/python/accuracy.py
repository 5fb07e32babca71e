# SPDX-License-Identifier: MIT OR Apache-2.0
"""How well predictions do per renderer: VTK's fixed-point and GPU mappers, ParaView, yt. Tables are collected, a network
and an analytic model trained on them, and judged on volumes that none of them saw; then a network that was trained on the
Vulkan raycaster's frames is fine-tuned with a twentieth of the frames. Called by bars.py; tables that are there are kept.

ENTIRE_DATA  folder with `scans/` and `ensembles/` (default ../shared/data)
YT_PYTHON    a Python with yt, without which yt is left out; pvbatch does ParaView, where it is there
"""
import glob
import json
import os
import shutil
import subprocess
import sys

HERE = os.path.dirname(os.path.abspath(__file__))
EXAMPLES = os.path.dirname(os.path.dirname(HERE))
UNSEEN_SCANS = ("ct_engine", "cta_avm", "uct_iguana", "mr_t2_brain", "ed_rhodopsin_3pqr", "mr_carotid_flow")
UNSEEN_MEMBERS = ("castro_blast/m02", "nyx_cosmology/m02", "maestroex_bubbles/m03")
STEPS = "1,1.5,2,3,4"


def volumes(data):
    """(training, unseen) volume files: scans, and a few time steps of every ensemble member."""
    scans = sorted(glob.glob(os.path.join(data, "scans", "*.nrrd")))
    unseen = [s for s in scans if os.path.splitext(os.path.basename(s))[0] in UNSEEN_SCANS]
    training = [s for s in scans if s not in unseen]
    for member in sorted(glob.glob(os.path.join(data, "ensembles", "*", "*"))):
        name = os.path.relpath(member, os.path.join(data, "ensembles"))
        steps = sorted(glob.glob(os.path.join(member, "*.nrrd")))
        if name in UNSEEN_MEMBERS:
            unseen += steps[2::7][:2]
        elif name.endswith(("m01", "run01")):
            training += steps[::4][:5]
    return training, unseen


def voxels(path):
    with open(path, "rb") as file:
        head = file.read(600).split(b"\n\n")[0].decode("ascii", "replace")
    x, y, z = (int(n) for n in head.split("sizes:")[1].split("\n")[0].split())
    return x * y * z


def collectors(program):
    """Renderer → (command, extra options, largest image side, largest volume)."""
    found = {
        "vulkan": ([program, "collect"], ["--steps", STEPS], 320, None),
        "fixed": ([sys.executable, os.path.join(HERE, "collect_vtk.py"), "--mapper", "fixed"], ["--steps", STEPS], 320, None),
        "gpu": ([sys.executable, os.path.join(HERE, "collect_vtk.py"), "--mapper", "gpu"], ["--steps", STEPS], 320, None),
    }
    script = os.path.join(EXAMPLES, "paraview", "python", "collect_paraview.py")
    if shutil.which("pvbatch"):
        found["paraview"] = (["pvbatch", script], [], 256, None)
    else:
        print("accuracy: ParaView is left out: pvbatch is not installed")
    if os.environ.get("YT_PYTHON"):
        found["yt"] = ([os.environ["YT_PYTHON"], os.path.join(EXAMPLES, "yt", "collect_yt.py")], [], 96, 4_200_000)
    else:
        print("accuracy: yt is left out: set YT_PYTHON to a Python that has it")
    return found


def collect(options, renderer, how, part, files, frames, seed):
    """The table of a renderer, collected where it is not there."""
    table = os.path.join(options.out, f"{renderer}-{part}.csv")
    if os.path.exists(table):
        return table
    command, extra, side, largest = how
    files = [f for f in files if largest is None or voxels(f) <= largest]
    unfinished = os.path.join(options.out, f"{renderer}-{part}.part.csv")
    for old in (unfinished, os.path.splitext(unfinished)[0] + ".manifest.json"):
        if os.path.exists(old):
            os.remove(old)
    least = 24 if side < 100 else 32
    environment = dict(os.environ)
    modules = os.environ.get("PARAVIEW_MODULES")
    if renderer == "paraview" and modules:
        environment["PYTHONPATH"] = modules
    subprocess.run(
        [*command, *extra, "--out", unfinished, "--frames", str(frames), "--repeats", "3", "--seed", str(seed),
         "--min-size", str(least), "--max-size", str(side), *files],
        check=True, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL, env=environment,
    )
    os.replace(os.path.splitext(unfinished)[0] + ".manifest.json", os.path.splitext(table)[0] + ".manifest.json")
    os.replace(unfinished, table)
    return table


def train(options, table, name, *extra):
    model = os.path.join(options.out, f"{name}.safetensors")
    subprocess.run([options.entire, "train", "--data", table, "--clock", "cpu", "--quiet", "--out", model, *extra],
                   check=True, stdout=subprocess.DEVNULL)
    return model


def judge(options, models, table, name):
    """Model → RMSE over SD of the frames."""
    out = os.path.join(options.out, f"evaluation-{name}")
    subprocess.run([options.entire, "evaluate", "--model", *models, "--data", table, "--clock", "cpu", "--quiet", "--out", out],
                   check=True, stdout=subprocess.DEVNULL)
    with open(os.path.join(out, "evaluation.json")) as file:
        result = json.load(file)
    return {p["name"]: p["metrics"] for p in result["predictors"]}, result["noise_floor"]


def run(options, bar):
    data = os.environ.get("ENTIRE_DATA", os.path.join("..", "shared", "data"))
    training, unseen = volumes(data)
    if not training or not unseen:
        print(f"accuracy: skipped: no volumes in {data}; set ENTIRE_DATA")
        return
    found = collectors(options.entire)
    base = None
    for renderer, how in found.items():
        learn = collect(options, renderer, how, "train", training, 100, 1)
        if renderer == "vulkan":
            base = train(options, learn, "vulkan-network", "--layers", "64,64")
            continue
        test = collect(options, renderer, how, "test", unseen, 40, 2)
        models = [train(options, learn, f"{renderer}-network", "--layers", "64,64"),
                  train(options, learn, f"{renderer}-analytic", "--model-kind", "analytic")]
        with open(learn) as file:
            frames = len({line.split(",", 1)[0] for line in file}) - 1
        few = max(10, int(0.04 * frames))
        models.append(train(options, learn, f"{renderer}-tuned", "--fine-tune", base, "--limit", str(few)))
        models.append(train(options, learn, f"{renderer}-few", "--layers", "64,64", "--limit", str(few)))
        scores, noise = judge(options, models, test, renderer)
        print(f"{renderer}: {frames} frames to learn from, noise floor log-SD {noise['log_sd']:.3f}")
        for name, m in scores.items():
            print(f"  {name:28} RMSE/SD {m['rmse_over_sd']:.3f}  MdAPE {100 * m['mdape']:.1f} %  R2(log) {m['r2_log']:.4f}")
        full = scores[f"{renderer}-network"]["rmse_over_sd"]
        bar(f"{renderer} RMSE/SD on unseen volumes", full, 0.15)
        bar(f"{renderer} fine-tuned with {few} frames / fully trained", scores[f"{renderer}-tuned"]["rmse_over_sd"] / full, 1.2)
