#!/usr/bin/env python3
# SPDX-License-Identifier: MIT OR Apache-2.0
"""Wall time divided by processor time: how much of its variation between frames could a model explain?

Usage: python3 lab/scripts/wall_ratio.py TABLE.csv.gz …

Fits wall / processor = a + b / processor to the means of each frame's repeats; b is a latency in which no processor
works. Prints the standard deviation of what the fit leaves, the standard deviation that the repeats alone explain, and
the share of the remaining variance that a linear function of all quantities of the frame and of its image size explains
(cross-validated by ensemble member, outliers clipped). The table's features must lie beside it (`entire features`).
Needs numpy.
"""

import csv
import gzip
import sys
from pathlib import Path

import numpy as np

CLIP = 0.1  # largest residual of wall / processor in the cross-validation
RIDGE = 30.0  # weight of the squared coefficients of standardized quantities


def lines(path):
    with gzip.open(path, "rt", encoding="utf-8", newline="") as table:
        return [line for line in table if not line.startswith("#")]


def explained(left, terms, members):
    """Share of the variance of `left` that a ridge regression on `terms` explains for members that it did not see."""
    left = np.clip(left, -CLIP, CLIP)
    terms = np.column_stack([np.ones(len(left)), (terms - terms.mean(0)) / (terms.std(0) + 1e-9)])
    guess = np.zeros_like(left)
    names = sorted(set(members))
    for fold in range(5):
        test = np.isin(members, names[fold::5])
        x, y = terms[~test], left[~test]
        guess[test] = terms[test] @ np.linalg.solve(x.T @ x + RIDGE * np.eye(x.shape[1]), x.T @ y)
    return 1 - ((left - guess) ** 2).mean() / left.var()


def report(path):
    repeats, size, member = {}, {}, {}
    for row in csv.DictReader(lines(path)):
        wall, processor = float(row["seconds_wall"] or 0), float(row["seconds_cpu"] or 0)
        if wall > 0 and processor > 0:
            repeats.setdefault(row["frame"], []).append((processor, wall / processor))
            size[row["frame"]] = [float(row["width_px"]), float(row["height_px"])]
            member[row["frame"]] = row["volume"].rsplit("/", 1)[0]
    frames = [frame for frame in repeats if len(repeats[frame]) > 1]
    if len(frames) < 10:
        sys.exit(f"{path}: fewer than 10 frames have two repeats with wall time and processor time")
    found = [np.array(repeats[frame]) for frame in frames]
    processor, ratio = np.array([r.mean(0) for r in found]).T
    noise = np.sqrt(np.mean([r[:, 1].var(ddof=1) / len(r) for r in found]))
    fit = np.column_stack([np.ones_like(processor), 1 / processor])
    (share, latency), *_ = np.linalg.lstsq(fit, ratio, rcond=None)
    left = ratio - fit @ (share, latency)
    features = {row.pop("frame"): row for row in csv.DictReader(lines(path.with_name(
        path.name.removesuffix(".csv.gz") + ".features.csv.gz")))}
    values = np.array([[float(v) for name, v in features[frame].items() if "@" not in name] for frame in frames])
    values = np.log1p(np.abs(values) / (np.median(np.abs(values), axis=0) + 1e-12))
    sizes = np.array([size[frame] for frame in frames])
    part = explained(left, np.column_stack([values, np.log(sizes), 1 / processor]), np.array([member[f] for f in frames]))
    print(f"{path.name}: {len(frames)} frames; wall / processor {np.median(ratio):.3f} (median); latency "
          f"{1e6 * latency:.0f} µs; standard deviation {ratio.std():.3f}, after the latency {left.std():.3f}, of "
          f"repeats {noise:.3f}; all quantities explain {100 * part:.0f} % of the remaining variance")


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    for name in sys.argv[1:]:
        report(Path(name))
