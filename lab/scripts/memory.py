#!/usr/bin/env python3
# SPDX-License-Identifier: MIT OR Apache-2.0
"""Compares formulas for the share of work that waits for memory, by cross-validated errors of unit costs.

Usage: python3 lab/scripts/memory.py [TABLE.csv …]

Reads the training tables in data/timings (ensemble members are held out), and joins the tables given as arguments into
one (volumes are held out). The tables' features must lie beside them (`entire features`). Unit costs are fitted by
reweighted non-negative least squares, which approximately minimizes the mean absolute relative error. A second table
compares formulas for the reads that the preceding sample of a ray does not share, on frames with a ray step of 1 and on
frames with other ray steps. Needs numpy and scipy.
"""

import csv
import gzip
import sys
from pathlib import Path

import numpy as np
from scipy.optimize import nnls

TRAINING = """none-train none-epyc-train none-xeon-train local-train local-xeon-train scatter-train
scatter-xeon-train""".split()
STEPS = "none none-epyc none-xeon local scatter".split()  # tables NAME-train and NAME-steps
NEAR = """pixels rays skips samples lane_samples runs segments local_samples scatter_samples shadow_samples
lane_shadow_samples""".split()
FAR = "far_skips far_samples far_segments far_local_samples far_shadow_samples far_x far_y far_z".split()
CACHED, READ = 4.0e6, 64.0  # CACHED_VOXELS and VOXELS_PER_READ of steer/src/features (cost.rs, frame.rs)


def new_reads(d):
    """Reads of a sample that the preceding sample of its ray, d reference steps away, does not share; 1 at d = 1."""
    return 3 * d / (d + 2)


def lines(path):
    opened = gzip.open(path, "rt") if path.name.endswith(".gz") else open(path, encoding="utf-8")
    with opened:
        return [line for line in opened if not line.startswith("#")]


def read(path, by_volume):
    """Median processor time, features and group of each frame."""
    path = Path(path)
    features = path.parent / (path.name.removesuffix(".gz").removesuffix(".csv") + ".features.csv.gz")
    seconds, group = {}, {}
    for row in csv.DictReader(lines(path)):
        seconds.setdefault(row["frame"], []).append(float(row["seconds_cpu"]))
        volume = row["volume"] + row["dims_x"] if by_volume else row["volume"].rsplit("/", 1)[0]
        group[row["frame"]] = volume
    rows = {row["frame"]: row for row in csv.DictReader(lines(features))}
    names = [*NEAR, *FAR, "voxels", "ray_spacing", "step"]
    found = {name: np.array([float(rows[k][name]) for k in seconds]) for name in names}
    return np.array([np.median(v) for v in seconds.values()]), found, np.array([group[k] for k in seconds])


def joined(tables):
    """Joins the frames of several tables."""
    features = {name: np.concatenate([f[name] for _, f, _ in tables]) for name in tables[0][1]}
    return np.concatenate([t for t, _, _ in tables]), features, np.concatenate([g for _, _, g in tables])


def work(f, law, new=new_reads):
    """Returns the amounts of work of each frame, one column per unit cost. `law` gets the number of voxels and the
    number of unshared reads (reads of memory that neighboring rays do not share). It returns the share of these reads
    that wait for memory, and the number of voxels that cost time (None: no voxels do). If `law` is None, no read waits.
    If `law` is a number of pixels, the formula of the shipped models is used, and a further unit cost is that of the
    share of pixels that do not fit in a cache of this number of pixels. `new` replaces the formula `new_reads`."""

    def by_distance(formula):
        """The formula at the distance of the samples; 1 for work that the distance does not change."""
        shadow = {"far_shadow_samples": formula(2 * f["step"])}
        return {name: formula(f["step"]) for name in FAR} | shadow | {"far_skips": 1.0, "far_segments": 1.0}

    columns = [np.ones_like(f["pixels"]), *(f[name] for name in NEAR)]
    if isinstance(law, float):
        columns.append(f["pixels"] ** 2 / (f["pixels"] + law))
        law = touched()
    if law:
        square = f["ray_spacing"] ** 2
        near = square / (square + 4.0)
        before, after = by_distance(new_reads), by_distance(new)
        far = {name: f[name] / before[name] for name in FAR}
        share = np.clip(far["far_samples"] / np.maximum(f["lane_samples"] * near, 1e-9), 1e-12, 0.999)
        reads = f["samples"] * near + (far["far_shadow_samples"] + far["far_local_samples"]) / share
        waiting, counted = law(f["voxels"], reads)
        columns += [far[name] * after[name] / share * waiting for name in FAR]
        if counted is not None:
            columns.append(counted)
    columns = np.stack(columns, 1)
    return columns[:, columns.max(0) > 0]


def fit(x, seconds):
    weight, scale = np.ones(len(seconds)), x.max(0)
    scale[scale == 0] = 1
    for _ in range(12):
        costs, _ = nnls(x / scale / seconds[:, None] * weight[:, None], weight, maxiter=10000)
        weight = 1 / np.sqrt(np.maximum(np.abs(x / scale @ costs / seconds - 1), 0.03))
    return costs / scale


def predictions(x, seconds, group):
    """Cross-validated predictions."""
    fold = {name: i % 7 for i, name in enumerate(np.unique(group))}
    fold = np.array([fold[name] for name in group])
    predicted = np.zeros(len(seconds))
    for i in np.unique(fold):
        predicted[fold == i] = x[fold == i] @ fit(x[fold != i], seconds[fold != i])
    return predicted


def errors(predicted, seconds):
    return np.median(np.abs(predicted / seconds - 1)), np.sqrt(np.mean((predicted - seconds) ** 2)) / seconds.std()


def touched(cached=CACHED, read=READ, counted=True, second=None, power=2):
    """The share w^power / (w^power + cached^power) of the touched voxels w; with `second`, the mean of the shares of two
    caches (or of a cache and a TLB)."""

    def law(n, reads):
        w = 1 / (1 / n + 1 / (read * np.maximum(reads, 1e-3)))
        shares = [1 / (1 + (size / w) ** power) for size in (cached, second) if size is not None]
        return sum(shares) / len(shares), w if counted else None

    return law


LAWS = {
    "no share": None,
    "n / (n + 2 million)": lambda n, _: (n / (n + 2.0e6), None),
    "w² / (w² + (4 million)²)": touched(counted=False),
    "... and a cost of each touched voxel": touched(),
    "... w² / (w² + (2 million)²)": touched(cached=2.0e6),
    "... w² / (w² + (8 million)²)": touched(cached=8.0e6),
    "... w / (w + 4 million)": touched(power=1),
    "... w / (w + 8 million)": touched(cached=8.0e6, power=1),
    "... w / (w + 16 million)": touched(cached=16.0e6, power=1),
    "... w³ / (w³ + (4 million)³)": touched(power=3),
    "... 32 voxels per read": touched(read=32.0),
    "... 128 voxels per read": touched(read=128.0),
    "... and a second cache: 0.25 million": touched(second=0.25e6),
    "... and a second cache: 1 million": touched(second=1.0e6),
    "... and a second cache: 64 million": touched(second=64.0e6),
    "... a cache of 16 thousand pixels": 16.0e3,
    "... a cache of 64 thousand pixels": 64.0e3,
    "... a cache of 256 thousand pixels": 256.0e3,
}


NEW = {
    "a constant share": lambda d: 1.0 + 0.0 * d,
    "d / (d + 1)": lambda d: 2 * d / (d + 1),
    "d / (d + 2)": new_reads,
    "d / (d + 4)": lambda d: 5 * d / (d + 4),
    "in proportion to d": lambda d: d,
}


def main():
    tables = [read(f"data/timings/{name}.csv.gz", by_volume=False) for name in TRAINING]
    given = [read(path, by_volume=True) for path in sys.argv[1:]]
    given = [joined(given)] if given else []
    print(f"{'share of unshared reads':36}  training tables (geometric mean)" + ("  tables given" if given else ""))
    for name, law in LAWS.items():
        means = [
            np.exp(np.mean(np.log([errors(predictions(work(f, law), t, g), t) for t, f, g in part]), axis=0))
            for part in (tables, given)
            if part
        ]
        print(f"{name:36}  " + "  ".join(f"{100 * m:5.2f} %, RMSE/SD {r:.4f}" for m, r in means), flush=True)
    parts = [[f"data/timings/{name}-{part}.csv.gz" for part in ("train", "steps")] for name in STEPS]
    tables = [joined([read(path, by_volume=False) for path in paths]) for paths in parts]
    print(f"\n{'reads that no preceding sample shares':36}  ray step 1             other ray steps")
    for name, new in NEW.items():
        found = []
        for t, f, g in tables:
            predicted, one = predictions(work(f, touched(), new), t, g), f["step"] == 1
            found.append([errors(predicted[at], t[at]) for at in (one, ~one)])
        means = np.exp(np.mean(np.log(found), axis=0))
        print(f"{name:36}  " + "  ".join(f"{100 * m:5.2f} %, RMSE/SD {r:.4f}" for m, r in means), flush=True)


if __name__ == "__main__":
    main()
