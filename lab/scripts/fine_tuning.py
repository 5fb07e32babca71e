#!/usr/bin/env python3
# SPDX-License-Identifier: MIT OR Apache-2.0
"""Fine-tunes the paper's network to ParaView on up to 30,000 predicted frame times, and prints the errors.

A teacher, entire's predictor calibrated to the measured frames of data/timings/paraview-train.csv.gz, predicts the
times of random frames of the same volumes. The shipped distilled network is fine-tuned to them; a network of the same
layers learns them from nothing. Both are tested on the measured frames of data/timings/paraview-test.csv.gz, of other
volumes.
Takes three minutes. An interrupted command continues.
"""
import argparse
import csv
import gzip
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TABLES = ROOT / "data/timings"
PRETRAINED = ROOT / "models/unshaded-distilled.safetensors"
# Numbers of frames, and passes over them.
FRAMES = {100: 100, 1000: 100, 10_000: 30, 30_000: 15}
# Share of the predicted frames whose volumes are for training; the other volumes are for validation and testing.
TRAINING_SHARE = 0.75
# Settings of ParaView's frames: sides of images in pixels, opacity at which a ray ends, and about its ray step.
SETTING = ("--min-size", "32", "--max-size", "192", "--skip", "none", "--termination", "0.996", "--steps", "0.5")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", required=True, type=Path, help="the folder that holds scans/ and ensembles/")
    parser.add_argument("--out", default=ROOT / "out/fine-tuning", type=Path, help="folder for labels and models")
    parser.add_argument("--bin", default=ROOT / "target/release/entire", type=Path, help="the program")
    options = parser.parse_args()
    out, program = options.out.resolve(), options.bin.resolve()
    out.mkdir(parents=True, exist_ok=True)

    def entire(*arguments):
        subprocess.run([program, *map(str, arguments)], cwd=options.data, check=True)

    teacher, labels = out / "teacher.safetensors", out / "labels.csv"
    measured, test = TABLES / "paraview-train.csv.gz", TABLES / "paraview-test.csv.gz"
    if not teacher.exists():
        entire("calibrate", "--data", measured, "--clock", "cpu", "--out", teacher, "--quiet")
    with gzip.open(measured, "rt", newline="") as file:
        volumes = sorted({row["volume"] for row in csv.DictReader(file)})
    each = int(max(FRAMES) / TRAINING_SHARE / len(volumes)) + 1
    entire("collect", *volumes, "--out", labels, *(["--resume"] if labels.exists() else []), "--frames", each, "--repeats", 1,
           "--warm-up", 0, "--seed", 7, *SETTING, "--teacher", teacher, "--quiet")
    models = [teacher, PRETRAINED]
    network = ("--preset", "12C256", "--inputs", "volume_features,camera,resolution,transfer_function", "--sorted-lobes",
               "--volumenet", ROOT / "models/volumenet-128f2.safetensors")
    for count, epochs in FRAMES.items():
        for how, start in (("fine-tuned", ("--fine-tune", PRETRAINED)), ("from nothing", network)):
            model = out / f"{how.replace(' ', '-')}-{count}.safetensors"
            models.append(model)
            if not model.exists():
                print(f"train {how}, {count} frames", flush=True)
                # An interrupted training writes its best weights and fails.
                part = out / "part.safetensors"
                entire("train", "--data", labels, "--limit", count, "--clock", "cpu", "--epochs", epochs, "--out", part,
                       "--quiet", *start)
                part.rename(model)
    entire("evaluate", "--clock", "cpu", "--model", *models, "--data", test, "--out", out / "evaluation", "--quiet")


if __name__ == "__main__":
    main()
