#!/usr/bin/env python3
# SPDX-License-Identifier: MIT OR Apache-2.0
"""Errors of a learned factor beyond the range of its training frames, measured on training frames only.

    beyond.py [--mode none|local|scatter] [--data data/timings]

For each input of the shipped model's factor and for both ends of its range, the outermost 15 % of the training frames are
left out, and unit costs and factor are fitted to the others. The frames left out are then predicted by the unit costs
alone (estimate), by the extrapolating factor (free), and by the factor with its inputs clamped to the range that it was
trained on (held). Needs Python 3.9, NumPy and PyTorch.
"""
import argparse
import csv
import gzip
import json
import re
import struct
from pathlib import Path

import numpy as np
import torch

ROOT = Path(__file__).resolve().parents[2]
TABLES = ("train", "steps", "small")
BEYOND = 0.15
EPOCHS, BATCH, HIDDEN, RATE = 60, 128, 16, 3e-3
ROUNDS = 12


def floors():
    """Constant that the logarithm of every quantity adds, from the schema of scene features."""
    text = (ROOT / "steer/src/features/schema.rs").read_text()
    return {name: float(floor.replace("_", "")) for name, floor in re.findall(r'"(\w+)", "[^"]*", ([0-9.e_-]+),', text)}


def metadata(path):
    with open(path, "rb") as file:
        return json.loads(file.read(struct.unpack("<Q", file.read(8))[0]))["__metadata__"]


def read(table, side):
    """Seconds (mean of repeats) and the columns of a table's features at a probe of `side` rays."""
    seconds = {}
    with gzip.open(table, "rt") as file:
        for row in csv.DictReader(file):
            seconds.setdefault(int(row["frame"]), []).append(float(row["seconds_cpu"]))
    with gzip.open(str(table).replace(".csv.gz", ".features.csv.gz"), "rt") as file:
        file.readline()
        rows = {int(row["frame"]): row for row in csv.DictReader(file)}
    frames = sorted(seconds)

    def column(name):
        return np.array([float(rows[f].get(f"{name}@{side}") or rows[f][name]) for f in frames])

    return np.array([np.mean(seconds[f]) for f in frames]), column


def fit_costs(work, seconds, prior):
    """Fits unit costs with a weak prior to ln(seconds); outliers are down-weighted."""
    paid = prior > 0
    work, log = work[:, paid], np.log(prior[paid])
    first = log.copy()
    for _ in range(ROUNDS):
        costs = np.exp(log)
        estimate = work @ costs
        rest = np.log(seconds / estimate)
        jacobian = work * costs / estimate[:, None]
        weight = np.minimum(1, 1.5 * 1.4826 * np.median(abs(rest)) / np.maximum(abs(rest), 1e-12))
        gram = (jacobian * weight[:, None]).T @ jacobian + 0.1 * np.eye(len(log))
        log += np.clip(np.linalg.solve(gram, (jacobian * weight[:, None]).T @ rest - 0.1 * (log - first)), -1, 1)
    costs = np.zeros(len(prior))
    costs[paid] = np.exp(log)
    return costs


def train(inputs, logs):
    """Trains a factor with two hidden layers. Returns a function of the inputs and of a flag that clamps them."""
    torch.manual_seed(1)
    generator = torch.Generator().manual_seed(1)
    mean, sd = inputs.mean(0), inputs.std(0) + 1e-9
    center, scale = logs.mean(), logs.std()
    x, y = torch.tensor((inputs - mean) / sd), torch.tensor((logs - center) / scale)
    widths = [x.shape[1], HIDDEN, HIDDEN, 1]
    layers = []
    for a, b in zip(widths, widths[1:]):
        layer = torch.nn.Linear(a, b)
        torch.nn.init.normal_(layer.weight, 0, a ** -0.5)
        torch.nn.init.zeros_(layer.bias)
        layers += [layer, torch.nn.SELU()]
    net = torch.nn.Sequential(*layers[:-1])
    optimizer = torch.optim.Adam(net.parameters(), lr=RATE)
    steps = EPOCHS * -(-len(y) // BATCH)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps, RATE / 100)
    for _ in range(EPOCHS):
        order = torch.randperm(len(y), generator=generator)
        for at in range(0, len(y), BATCH):
            some = order[at:at + BATCH]
            loss = ((net(x[some])[:, 0] - y[some]) ** 2).mean()
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
            optimizer.step()
            schedule.step()
    low, high = inputs.min(0), inputs.max(0)

    def factor(inputs, held):
        inputs = np.clip(inputs, low, high) if held else inputs
        with torch.no_grad():
            return net(torch.tensor((inputs - mean) / sd))[:, 0].numpy() * scale + center

    return factor


def errors(predicted, seconds):
    """Median error, RMSE/SD."""
    return np.median(abs(predicted / seconds - 1)), np.sqrt(np.mean((predicted - seconds) ** 2)) / np.std(seconds)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mode", default="local", choices=("none", "local", "scatter"))
    parser.add_argument("--data", default=ROOT / "data/timings", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    torch.set_default_dtype(torch.float64)
    model = "unshaded" if options.mode == "none" else options.mode
    told = metadata(ROOT / f"models/{model}-selected.safetensors")
    names = json.loads(told["entire.scene_features"])[:-1]
    prior = json.loads(told["entire.unit_costs"])
    side = int(told.get("entire.probe_side", 11))
    add = floors()
    seconds, inputs, work = [], [], []
    for name in TABLES:
        table = options.data / f"{options.mode}-{name}.csv.gz"
        if not table.exists():
            continue
        times, column = read(table, side)
        seconds.append(times)
        inputs.append(np.stack([np.log(column(n[4:]) + add[n[4:]]) if n.startswith("log_") else column(n) for n in names], 1))
        work.append(np.stack([np.ones(len(times)) if q == "frame" else column(q) for q in prior], 1))
    seconds, inputs, work = np.concatenate(seconds), np.concatenate(inputs), np.concatenate(work)
    start = np.array(list(prior.values()))
    kinds = ("estimate", "free", "held")
    print(f"{options.mode}: {len(seconds)} training frames; median error and RMSE/SD beyond")
    print(f"{'input':<26}{'end':<6}{'frames':>7}" + "".join(f"{k:>18}" for k in kinds))
    found = []
    for i, name in enumerate(names):
        for end, level in (("low", BEYOND), ("high", 1 - BEYOND)):
            edge = np.quantile(inputs[:, i], level)
            beyond = inputs[:, i] < edge if end == "low" else inputs[:, i] > edge
            if not 100 <= beyond.sum() <= len(seconds) / 2:
                continue
            costs = fit_costs(work[~beyond], seconds[~beyond], start)
            estimate = work @ costs
            rest = np.log(seconds / estimate)
            factor = train(inputs[~beyond], rest[~beyond])
            logs = [np.median(rest[~beyond]), factor(inputs[beyond], False), factor(inputs[beyond], True)]
            found.append([errors(estimate[beyond] * np.exp(log), seconds[beyond]) for log in logs])
            print(f"{name:<26}{end:<6}{beyond.sum():>7}" + "".join(f"{100 * m:>10.1f} % {r:.3f}" for m, r in found[-1]), flush=True)
    for what, over in (("geometric mean", lambda v: np.exp(np.log(v).mean(0))), ("worst", lambda v: v.max(0))):
        print(f"{what:<39}" + "".join(f"{100 * m:>10.1f} % {r:.3f}" for m, r in over(np.array(found))))


if __name__ == "__main__":
    main()
