"""Trains VolumeNet for every requested input size and feature length, and draws the results.

    python sweep.py                                              # 64^3, F = 2, 4, 8, 16, 32, the volumes in ../../data
    python sweep.py --sizes 64,128 --features 2,8 --data PATH --epochs 60 --val-members A/m04 --test-members A/m05

All other options are passed to train_volumenet.py. Finished trainings are kept, and an interrupted one is resumed.
Writes into --out: the model files, table.md (peak signal-to-noise ratio per dataset), psnr.svg, and
features-<size>.svg (the feature vectors of all volumes with F = 2, a path per ensemble member).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import matplotlib

matplotlib.use("svg")
import matplotlib.pyplot as plt
import numpy as np
import torch

from volumenet import find_volumes, load_model, network_input

HERE = Path(__file__).resolve().parent
PARTS = ("train", "validation", "test")


def numbers(text: str) -> list[int]:
    return [int(n) for n in text.split(",")]


def train(size: int, features: int, args: argparse.Namespace, rest: list[str]) -> dict:
    """The record that train_volumenet.py writes beside the model; trains unless it exists."""
    out = args.out / f"volumenet-{size}f{features}.safetensors"
    record = out.with_suffix(".json")
    if not record.exists():
        command = [sys.executable, str(HERE / "train_volumenet.py"), "--data", str(args.data), "--out", str(out)]
        command += ["--size", str(size), "--features", str(features), "--resume", *rest]
        print(f"{size}^3, F = {features}", flush=True)
        if subprocess.run(command).returncode or not record.exists():
            sys.exit(f"{size}^3, F = {features}: training failed; run the same command again to go on from its checkpoint")
    found = json.loads(record.read_text())
    if found["provenance"]["stopped"].startswith("interrupted"):
        record.unlink()
        sys.exit("interrupted; run the same command again to go on")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=numbers, default=[64], help="input sides (default 64)")
    parser.add_argument("--features", type=numbers, default=[2, 4, 8, 16, 32], help="lengths of the feature vector")
    parser.add_argument("--data", type=Path, default=HERE.parent.parent / "data", help="folder with volumes")
    parser.add_argument("--out", type=Path, default=HERE.parent.parent / "out" / "volumenet")
    args, rest = parser.parse_known_args()
    args.out.mkdir(parents=True, exist_ok=True)
    records = {(s, f): train(s, f, args, rest) for s in args.sizes for f in args.features}
    args.features.sort()

    datasets = sorted({d for r in records.values() for p in r["provenance"]["psnr_db"].values() for d in p})
    lines = ["| input | F | epochs, best | seconds | " + " | ".join(f"{d}: {', '.join(PARTS)}" for d in datasets) + " |"]
    lines.append("|---|---|---|---|" + "---|" * len(datasets))
    for (size, features), record in records.items():
        made = record["provenance"]
        cells = []
        for dataset in datasets:
            found = (made["psnr_db"].get(part, {}).get(dataset) for part in PARTS)
            cells.append(", ".join("–" if value is None else f"{value:.1f}" for value in found))
        epochs = f"{made['epochs_run']}, {made['best_epoch']}"
        lines.append(f"| {size}³ | {features} | {epochs} | {record['seconds']:.0f} | " + " | ".join(cells) + " |")
    table = "\n".join(lines) + "\n"
    (args.out / "table.md").write_text(table)
    print(table)

    figure, axes = plt.subplots(1, len(datasets), figsize=(4 * len(datasets), 3.4), sharey=True, squeeze=False)
    for axis, dataset in zip(axes[0], datasets):
        for size in args.sizes:
            for part, style in zip(PARTS, ("-", "--", ":")):
                found = {f: records[size, f]["provenance"]["psnr_db"].get(part, {}).get(dataset) for f in args.features}
                points = [(f, value) for f, value in found.items() if value is not None]
                if points:
                    axis.plot(*zip(*points), style, marker="o", label=f"{size}³ {part}")
        axis.set(title=dataset, xlabel="features F", xscale="log", xticks=args.features, xticklabels=args.features)
        axis.minorticks_off()
    axes[0][0].set_ylabel("PSNR / dB")
    axes[0][-1].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(args.out / "psnr.svg")

    if 2 not in args.features:
        return
    files = find_volumes(args.data, sorted(datasets))
    for size in args.sizes:
        made = records[size, 2]["provenance"]
        model = load_model(args.out / f"volumenet-{size}f2.safetensors")
        part_of = {name: part for part, names in made["files"].items() for name in names}
        paths: dict[str, list[tuple[np.ndarray, str]]] = defaultdict(list)
        for file in files:
            part = part_of.get(f"{file.member}/{file.path.name}")
            if part is not None:
                with torch.no_grad():
                    code = model.encode(network_input(file.path, size)[None])[0].numpy()
                paths[file.member].append((code, part))
        figure, axis = plt.subplots(figsize=(7, 5))
        hues = {dataset: plt.get_cmap("tab10")(i) for i, dataset in enumerate(datasets)}
        marks = dict(zip(PARTS, ("o", "s", "^")))
        for member, codes in sorted(paths.items()):
            x, y = np.array([code for code, _ in codes]).T
            hue = hues[member.split("/")[0]]
            axis.plot(x, y, color=hue, linewidth=0.6, alpha=0.8)
            for part, mark in marks.items():
                of_part = [code for code, found in codes if found == part]
                if of_part:
                    axis.plot(*np.array(of_part).T, mark, color=hue, markersize=4, alpha=0.8)
            axis.annotate(member, (x[-1], y[-1]), fontsize=6)
        for part, mark in marks.items():
            axis.plot([], [], color="gray", linestyle="", marker=mark, label=part)
        axis.legend(fontsize=8)
        axis.set(title=f"VolumeNet {size}³, a path per member in order of time", xlabel="feature 1", ylabel="feature 2")
        figure.tight_layout()
        figure.savefig(args.out / f"features-{size}.svg")


if __name__ == "__main__":
    main()
