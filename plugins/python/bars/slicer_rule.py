# SPDX-License-Identifier: MIT OR Apache-2.0
"""Compares entire with 3D Slicer's own adaptive rule in Slicer's 3D view, while presets are switched.

    slicer_rule.py [VOLUME.nrrd] [--rate FPS] [--clock wall|cpu] [--out out/python/slicer.csv]

Two views, each with its own scene, draw every frame: entire steers one of them, Slicer's rule the other. Prints a row of
results for each view, and writes both rows to the file --out, in which rows of the other clock stay. Without VOLUME, the
views show a synthetic volume like a CT scan. A frame's time is that of vtkRenderWindow::Render() and includes the work of
the graphics device. On a shared machine, use `--clock cpu`: it counts processor time, with one thread of Mesa's software
driver, so that without other load both clocks agree. Slicer's rule measures wall time in any case, so other load makes
its frames coarser.
"""

import argparse
import csv
import math
import os
import platform
import sys
import time
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / "tests"), str(Path(__file__).resolve().parents[2] / "vtk/python")]

import entire.slicer  # noqa: E402
from slicer_view import SlicerView, preset  # noqa: E402
from timing_table import read_nrrd  # noqa: E402

FRAMES_OF_A_PRESET = 40
# Time of a frame, as a multiple of the target, above which the frame counts as over the limit.
LIMIT = 1.25
# Presets for bones, soft tissue, skin, vessels and haze: opacities at fractions of the largest scalar, and shading.
PRESETS = (
    (((0, 0), (0.45, 0), (0.6, 0.6), (1, 0.9)), True),
    (((0, 0), (0.2, 0), (0.4, 0.15), (0.6, 0.3), (1, 0.4)), True),
    (((0, 0), (0.08, 0), (0.14, 0.5), (0.2, 0), (1, 0)), True),
    (((0, 0), (0.55, 0), (0.7, 0.2), (1, 1)), False),
    (((0, 0), (0.03, 0), (0.3, 0.01), (1, 0.05)), False),
)
# Color points of all presets: a fraction of the largest scalar, red, green, blue.
COLORS = ((0, 0, 0, 0), (0.3, 0.55, 0.25, 0.15), (0.6, 0.9, 0.8, 0.6), (1, 1, 1, 1))


def ct_like(edge=160):
    """Makes skin, soft tissue, bones and vessels of ellipsoids and tubes with noise: uint8 voxels [z, y, x]."""
    z, y, x = np.meshgrid(*(np.linspace(-1, 1, edge, dtype=np.float32),) * 3, indexing="ij")
    body = (x / 0.9) ** 2 + (y / 0.65) ** 2
    volume = np.where(body < 1, 0.12, 0.0) + np.where(body < 0.9, 0.22, 0.0)
    spine = x**2 + (y - 0.35) ** 2
    volume += np.where(spine < 0.015 + 0.005 * np.sin(24 * z), 0.4, 0.0)
    ribs = (np.abs(body - 0.75) < 0.03) & (np.sin(14 * z + 3 * y) > 0.5)
    volume += np.where(ribs, 0.35, 0.0)
    vessel = (x - 0.1 * np.sin(4 * z)) ** 2 + (y - 0.05) ** 2
    volume += np.where(vessel < 0.004, 0.3, 0.0)
    volume += np.random.default_rng(20261126).normal(0, 0.02, volume.shape)
    return (255 * np.clip(volume, 0, 1)).astype(np.uint8)


def volume_of(path):
    """Returns the name of a volume, its voxels and their spacing."""
    if path is None:
        voxels = ct_like()
        return f"synthetic CT of {len(voxels)}^3 voxels", voxels, (1.0, 1.0, 1.0)
    volume = read_nrrd(path)
    return Path(path).name, volume.voxels, volume.spacing


def machine():
    """Returns the name of the processor."""
    info = Path("/proc/cpuinfo")
    names = [line.split(": ", 1)[1] for line in info.read_text().splitlines() if line.startswith("model name")] if info.exists() else []
    return names[0] if names else platform.processor()


class Arm:
    """One of the two compared views, and the seconds of its frames."""

    def __init__(self, name, voxels, spacing, rate, size, clock):
        self.name, self.now, self.seconds = name, clock, []
        self.view = SlicerView(size)
        self.view.node.SetVolumeRenderingQuality(self.view.node.Adaptive)
        self.view.node.SetExpectedFPS(rate)
        self.display = self.view.show(voxels, spacing)
        self.scale = float(voxels.max())
        self.extent = max(n * s for n, s in zip(voxels.shape[::-1], spacing))
        self.choose(0)
        self.view.move()

    def choose(self, which):
        opacity, shade = PRESETS[which]
        preset(
            self.display,
            [(at * self.scale, value) for at, value in opacity],
            [(at * self.scale, *rgb) for at, *rgb in COLORS],
            shade,
        )

    def draw(self, frame):
        self.view.orbit(2.5 * frame, self.extent * (2.0 + 0.4 * math.sin(0.05 * frame)), 20 + 15 * math.sin(0.03 * frame))
        began = self.now()
        self.view.window.Render()
        self.view.window.WaitForCompletion()
        self.seconds.append(self.now() - began)

    def row(self, target, scene):
        share = np.asarray(self.seconds) / target
        return {
            **scene,
            "rule": self.name,
            "frames": len(share),
            "target_ms": f"{1e3 * target:.1f}",
            "over_percent": f"{100 * np.mean(share > LIMIT):.2f}",
            "median_share": f"{np.median(share):.3f}",
            "worst_share": f"{share.max():.2f}",
            "deviation": f"{np.mean(np.abs(share - 1)):.3f}",
        }


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("volume", nargs="?")
    parser.add_argument("--rate", type=float, default=8.0, help="the view's expected frame rate (default 8, Slicer's)")
    parser.add_argument("--size", type=int, default=256, help="pixels along each side (default 256)")
    parser.add_argument("--clock", choices=("wall", "cpu"), default="wall", help="clock of frame times (default wall)")
    parser.add_argument("--out", type=Path, default=Path("out/python/slicer.csv"))
    options = parser.parse_args()
    if options.clock == "cpu":
        os.environ["LP_NUM_THREADS"] = "1"
    clock = time.process_time if options.clock == "cpu" else time.perf_counter
    name, voxels, spacing = volume_of(options.volume)
    size = (options.size, options.size)
    arms = [Arm(name, voxels, spacing, options.rate, size, clock) for name in ("entire", "slicer")]
    steering = entire.slicer.hold(arms[0].view.manager, clock=options.clock)
    # The first frame also creates buffers and shaders, so it is not counted.
    for arm in arms:
        arm.draw(0)
        arm.seconds.clear()
    for frame in range(FRAMES_OF_A_PRESET * len(PRESETS)):
        for arm in arms if frame % 2 else arms[::-1]:
            if frame % FRAMES_OF_A_PRESET == 0:
                arm.choose(frame // FRAMES_OF_A_PRESET)
            arm.draw(frame)
    if steering.fallback_frames:
        sys.exit(f"slicer_rule.py: {steering.fallback_frames} frames were not steered: {steering.status}")
    scene = {"machine": machine(), "clock": options.clock, "volume": name, "size": options.size}
    rows = [arm.row(1 / options.rate, scene) for arm in arms]
    options.out.parent.mkdir(parents=True, exist_ok=True)
    kept = []
    if options.out.exists():
        with open(options.out, newline="", encoding="utf-8") as file:
            kept = [row for row in csv.DictReader(file) if row.keys() == rows[0].keys() and row["clock"] != options.clock]
    with open(options.out, "w", newline="", encoding="utf-8") as file:
        out = csv.DictWriter(file, rows[0], lineterminator="\n")
        out.writeheader()
        out.writerows(kept + rows)
    for row in rows:
        print(", ".join(f"{key} {value}" for key, value in row.items()))


if __name__ == "__main__":
    main()
