# SPDX-License-Identifier: MIT OR Apache-2.0
"""Picture error and time of a mapper at coarser ray steps and smaller images.

    plugins/vtk/run.sh exec /usr/bin/python3 lab/scripts/vtk/tradeoff.py --mapper gpu --table tradeoff-gpu.csv

Draws frames of volumes, cameras and transfer functions that compare.py does not use, each at every pair of sample
distance and image sample distance, and writes a table (an existing one is read instead) with the processor time (the
smallest of the repeats) and the image error (root mean squared difference of 8-bit colors from full quality) of each
picture.

Then it fits the numbers w, p, q and r that vtkEntireSteering takes as its FixedPointQuality or GPUQuality. They are
parameters of two equations, called the law: error^n = a ((s - 1)^p + w (d - 1)^q), and time = (r + (1 - r) / s) / d^2.
Here s is the step in finest steps, d the distance of rays in pixels, and r the share of the time that does not depend
on the step; n and a may have any value. The fit is by least squares in logarithms of the means over scenes, of pictures
that take at most LONGEST of the full time (with more time, colors differ by their rounding alone). The numbers are then
adjusted so that the pairs that the law chooses have the smallest errors.

Prints w p q r. At several shares of the full time, prints the error of the pair that the law chooses, divided by the
error of the best pair, of the best step alone, of the best image size alone, and of the best image size at about twice
the step.
"""
import argparse
import csv
import math
import os
import sys

import numpy as np

HERE = os.path.dirname(os.path.abspath(__file__))
sys.path.insert(0, os.path.join(HERE, "..", "..", "..", "plugins", "vtk", "python"))
import vtk_scene  # noqa: E402
from timing_table import timed  # noqa: E402

STEPS = (1.0, 1.2, 1.45, 1.75, 2.1, 2.5, 3.0, 4.0)
IMAGES = (1.0, 1.1, 1.2, 1.44, 1.728, 2.0736)
COLOR = ((0, 0.0, 0.2, 0.4), (110, 0.2, 0.7, 0.3), (255, 1.0, 0.9, 0.9))
FUNCTIONS = {
    "thin": ((0, 0.0), (30, 0.0), (255, 0.05)),
    "dense": ((0, 0.0), (40, 0.0), (90, 0.25), (255, 0.4)),
    "shell": ((0, 0.0), (60, 0.0), (75, 0.3), (90, 0.0), (255, 0.02)),
}
SEEDS = (11, 23)
LONGEST = 0.7


def eye(index, n):
    """Position of the eye: irregular directions, near and far."""
    azimuth, elevation = 2.4 * index + 0.5, 0.9 * math.sin(1.7 * index + 0.3)
    distance = n * (1.7 + 0.5 * (index % 3))
    return (
        distance * math.cos(elevation) * math.sin(azimuth),
        distance * math.sin(elevation),
        distance * math.cos(elevation) * math.cos(azimuth),
    )


def collect(options):
    rows = []
    for seed in SEEDS:
        view = vtk_scene.View(options.mapper, vtk_scene.image_data(vtk_scene.noise_volume(options.edge, seed)), (options.size,) * 2)
        color = vtk_scene.color_function(COLOR)
        for name, points in FUNCTIONS.items():
            view.functions(vtk_scene.opacity_function(points), color)
            for index in range(options.poses):
                view.camera(eye(index, options.edge))
                view.adjust_off()
                found = vtk_scene.compared(view, lambda: timed(view.window.Render), 1.0, IMAGES, STEPS, options.repeats)
                for image, step, times, error in found:
                    rows.append({"scene": f"{seed}-{name}-{index}", "step": step, "image": image, "cpu": min(times), "error": error})
    part = options.table + ".part"
    with open(part, "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys(), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    os.replace(part, options.table)


def grids(path):
    """Returns the logarithms of the time divided by that of full quality, and of the error, as [scene, image, step]."""
    scenes = {}
    with open(path, newline="") as file:
        for row in csv.DictReader(file):
            at = IMAGES.index(float(row["image"])), STEPS.index(float(row["step"]))
            grid = scenes.setdefault(row["scene"], np.zeros((2, len(IMAGES), len(STEPS))))
            grid[:, at[0], at[1]] = float(row["cpu"]), max(float(row["error"]), 1e-3)
    both = np.log(np.array(list(scenes.values())))
    return both[:, 0] - both[:, 0, :1, :1], both[:, 1]


def law(weight, p, q, rays):
    """Logarithms of time and error of every pair by the law. The error of full quality is zero, its logarithm -inf."""
    s, d = np.array(STEPS)[None, :], np.array(IMAGES)[:, None]
    with np.errstate(divide="ignore"):
        return np.log((rays + (1 - rays) / s) / d**2), np.log((s - 1) ** p + weight * (d - 1) ** q)


def descend(loss, at, scale, rounds=400):
    """Returns the place of a local minimum of `loss`, found by steps along each axis, which are halved if none
    helps."""
    at, scale, least = np.array(at, float), np.array(scale, float), loss(at)
    for _ in range(rounds):
        before = least
        for axis in range(len(at)):
            for sign in (1, -1):
                other = at.copy()
                other[axis] += sign * scale[axis]
                if loss(other) < least:
                    at, least = other, loss(other)
        if least == before:
            scale *= 0.5
    return at


def fit(times, errors):
    time, error = times.mean(0), errors.mean(0)
    rays = min(np.linspace(0, 0.9, 181), key=lambda r: ((law(1, 1, 1, r)[0] - time) ** 2).sum())
    counts = time <= math.log(LONGEST)

    def off(v):
        model = law(math.exp(v[0]), v[1], v[2], rays)[1][counts]
        # The slope is 1 / n of the law.
        model = model - model.mean()
        wanted = error[counts] - error[counts].mean()
        slope = max((model * wanted).sum() / (model**2).sum(), 1e-3)
        return float(((slope * model - wanted) ** 2).mean())

    def loss(v):
        return off(v) if 0.2 <= v[1] <= 6 and 0.2 <= v[2] <= 6 else math.inf

    # Errors of every level of image size at these shares of the full time.
    shares = np.arange(0.2, LONGEST, 0.02)
    found = np.array([[at_share(t, e, share) for share in shares] for t, e in zip(time, error)])
    best = np.nanmin(found, 0)

    def regret(v):
        t, e = law(math.exp(v[0]), v[1], v[2], rays)
        chosen = [none_last(np.array([at_share(*level, share) for level in zip(t, e)])).argmin() for share in shares]
        return float(np.nan_to_num(found[chosen, range(len(shares))] - best, nan=1.0).mean())

    at = descend(loss, (1.0, 1.5, 1.5), (0.5, 0.2, 0.2))
    at = descend(lambda v: regret(v) + 0.1 * math.sqrt(loss(v)), at, (0.5, 0.2, 0.2), 25)
    return math.exp(at[0]), at[1], at[2], rays, math.sqrt(loss(at))


def at_share(time, error, share):
    """The error at a share of the full time along pairs in the order of their times, by linear interpolation in
    logarithms; NaN beyond them."""
    order = np.argsort(time)
    if not time.min() <= math.log(share) <= time.max():
        return math.nan
    return float(np.interp(math.log(share), time[order], error[order]))


def report(times, errors, numbers):
    """Prints geometric means over scenes: the error of the law's choice divided by those of other choices; and the
    error of each scene's best pair divided by that of smaller images at twice the step."""
    time, error = law(*numbers[:4])
    rows = [("step alone", [(0, k) for k in range(len(STEPS))]), ("image alone", [(k, 0) for k in range(len(IMAGES))]),
            ("image at step 2.1", [(k, STEPS.index(2.1)) for k in range(len(IMAGES))])]
    levels = [[(i, k) for k in range(len(STEPS))] for i in range(len(IMAGES))]
    for share in (0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2):
        own = min(levels, key=lambda pairs: none_last(at_share(*(np.array([g[p] for p in pairs]) for g in (time, error)), share)))
        text = []
        found = {}
        for name, pairs in [("best", None), *rows]:
            ratios = []
            for t, e in zip(times, errors):
                def on(pairs):
                    return at_share(np.array([t[p] for p in pairs]), np.array([e[p] for p in pairs]), share)

                other = min((on(each) for each in levels), key=none_last) if pairs is None else on(pairs)
                ratios.append(on(own) - other)
            found[name] = np.array(ratios)
            text.append(f"{name} {factor(ratios)}")
        text.append(f"best over image at step 2.1 {factor(found['image at step 2.1'] - found['best'])}")
        print(f"  at {share:.1f} of the time, image sample distance {IMAGES[own[0][0]]:.2f}: error over that of " + ", ".join(text))


def factor(logarithms):
    """The geometric mean of the known values, as text."""
    known = [v for v in logarithms if not math.isnan(v)]
    return f"{math.exp(np.mean(known)):.2f}" if known else "-"


def none_last(v):
    return np.where(np.isnan(v), math.inf, v)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mapper", choices=("fixed", "gpu"), default="fixed")
    parser.add_argument("--table", required=True, help="the pictures' times and errors (CSV)")
    parser.add_argument("--edge", type=int, default=256)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--poses", type=int, default=3)
    parser.add_argument("--repeats", type=int, default=2)
    options = parser.parse_args()
    if not os.path.exists(options.table):
        collect(options)
    times, errors = grids(options.table)
    numbers = fit(times, errors)
    print(f"{options.mapper}: quality {numbers[0]:.3g} {numbers[1]:.2f} {numbers[2]:.2f} {numbers[3]:.2f}"
          f" (off by {numbers[4]:.2f} in ln(error) over {len(times)} scenes)")
    report(times, errors, numbers)


if __name__ == "__main__":
    main()
