# SPDX-License-Identifier: MIT OR Apache-2.0
"""VTK's AutoAdjustSampleDistances against vtkEntireSteering on one camera path.

256^3 voxels, 512 x 512 pixels, 200 frames: an orbit with changing elevation and distance, a transparent and an opaque
transfer function in turn, switched abruptly at frames 50, 100 and 150. Contenders draw each frame one after the other,
so that other work on the machine affects all contenders equally:

  full        full quality: sample distance 1, nothing adjusted
  auto        AutoAdjustSampleDistances as shipped, asked for 1 / target
  between     AutoAdjustSampleDistances asked for a rate between that of `auto` and that of `scaled`
  scaled      AutoAdjustSampleDistances asked for the lower rate at which its mean frame time is the target. The rate is
              found by bisection in short runs, then refined in at most five runs of the whole path, until the mean frame
              time is within MEET of the target
  cold        vtkEntireSteering without a model, learning from its first frame on
  calibrated  vtkEntireSteering with a model fitted to random frames of this mapper (--model), of other volumes

There is a target by processor time and one by wall time: half of the mean frame time of `full` by that clock, from a
first pass of every tenth frame of the path. Each contender is scored by the clock that it steers by:
AutoAdjustSampleDistances sees the wall time of a render, vtkEntireSteering what --clock says. Image error is the root
of the mean squared difference of 8-bit colors from `full`, per frame.
"""
import argparse
import csv
import json
import math
import os
import statistics
import sys

import numpy as np

HERE = os.path.dirname(os.path.abspath(__file__))
sys.path.insert(0, os.path.join(HERE, "..", "..", "..", "plugins", "vtk", "python"))
import vtk_scene  # noqa: E402
from timing_table import timed  # noqa: E402
from vtk_scene import COLOR, OPAQUE, TRANSPARENT, camera  # noqa: E402

SWITCHES = (50, 100, 150)

# Tolerance of the mean frame time of `scaled` around the target, as a fraction of the target.
MEET = 0.03

# Factor on the target of each contender with AutoAdjustSampleDistances, as a function of the factor of `scaled`.
RIVALS = {"auto": lambda scale: 1.0, "between": math.sqrt, "scaled": lambda scale: scale}


class Contender:
    def __init__(self, name, mapper, image, size, options):
        self.name = name
        self.view = vtk_scene.View(mapper, image, (size, size))
        self.color = vtk_scene.color_function(COLOR)
        self.functions = [vtk_scene.opacity_function(p) for p in (TRANSPARENT, OPAQUE)]
        self.steering = None
        self.rows = []
        if name in ("full", "cold", "calibrated"):
            self.view.adjust_off()
        else:
            self.view.mapper.SetAutoAdjustSampleDistances(1)
        if name in ("cold", "calibrated"):
            from entire_vtk.vtkEntireSteering import vtkEntireSteering

            self.steering = vtkEntireSteering()
            self.steering.SetStillUpdateRate(0)
            if options.clock == "cpu":
                self.steering.SetClockToProcessCPU()
            if name == "calibrated":
                self.steering.SetModelFileName(options.model)
            self.steering.Attach(self.view.renderer, self.view.volume)

        # The window is made before the first frame. One-time work of the mapper counts as part of that frame.
        self.view.volume.VisibilityOff()
        self.view.window.Render()
        self.view.volume.VisibilityOn()

    def aim(self, target_cpu, target_wall, clock, scale):
        if self.name in RIVALS:
            self.view.window.SetDesiredUpdateRate(1 / (RIVALS[self.name](scale) * target_wall))
        elif self.steering:
            self.steering.SetTargetFrameTime(target_cpu if clock == "cpu" else target_wall)

    def pose(self, frame, frames, n):
        opaque = sum(frame >= frames * s // 200 for s in SWITCHES) % 2
        self.view.functions(self.functions[opaque], self.color)
        self.view.camera(camera(frame, frames, n))
        return opaque

    def draw(self, frame, frames, n, reference):
        opaque = self.pose(frame, frames, n)
        wall, cpu = timed(self.view.window.Render)
        pixels = self.view.pixels().astype(np.float32)
        row = {"frame": frame, "tf": "TO"[opaque], "wall": wall, "cpu": cpu}
        row["error"] = 0.0 if reference is None else vtk_scene.rmse(pixels, reference)
        s = self.steering
        if s:
            row.update(
                step=s.GetSampleDistance(),
                image=s.GetImageSampleDistance(),
                predicted=s.GetPredictedTime(),
                measured=s.GetMeasuredTime(),
                observer=s.GetObserverTime(),
                reason=s.GetReason(),
            )
            if s.GetReason() == "fallback":
                sys.exit(f"{self.name}: not steered: {s.GetStatus()}")
        self.rows.append(row)
        return pixels


def score(rows, full, clock, target):
    """Figures of one contender's frames against the target."""
    times = [r[clock] for r in rows]
    relative = [t / target for t in times]
    off = [abs(r - 1) for r in relative]
    # Frames that would miss the target at full quality: only these need steering.
    hard = [abs(r - 1) for r, f in zip(relative, full) if f[clock] > target]
    frames = len(rows)
    recovery = []
    for switch in SWITCHES:
        at = frames * switch // 200
        late = 0
        while at + late < frames and not all(r <= 1.25 for r in relative[at + late : at + late + 3]):
            late += 1
        recovery.append(late)
    return {
        "mean_ms": 1e3 * statistics.fmean(times),
        "off": statistics.fmean(off),
        "off_hard": statistics.fmean(hard) if hard else float("nan"),
        "over": sum(r > 1.25 for r in relative) / frames,
        "under": sum(r < 0.75 for r in relative) / frames,
        "worst": max(relative),
        "recovery": recovery,
        "error": statistics.fmean(r["error"] for r in rows),
    }


def clock_of(name, options):
    """The clock by which a contender steers, and by which it is scored."""
    return "wall" if name in RIVALS else options.clock


def find_scale(options, image, n, target_cpu, target_wall):
    """Returns the factor, 1 to 16, on the wall target of AutoAdjust with which its mean frame time is closest to the
    target, and this mean time divided by the target. The mappers treat a frame of a second or more as a still one, so
    the factor keeps the target below a second. If frames are shorter than the target even with the largest factor, that
    factor is returned."""
    most = max(1.0, min(16.0, 0.95 / target_wall))

    def spent(scale, frames, repeats):
        contender = Contender("scaled", options.mapper, image, options.size, options)
        contender.aim(target_cpu, target_wall, options.clock, scale)
        times = []
        for frame in frames:
            # A pose is drawn several times so that the mapper adapts; the last time counts.
            for _ in range(repeats):
                contender.pose(frame, options.frames, n)
                wall, _ = timed(contender.view.window.Render)
            times.append(wall)
        return statistics.fmean(times) / target_wall

    low, high = 1.0, most
    for _ in range(6):
        scale = math.sqrt(low * high)
        if spent(scale, range(options.frames // 24, options.frames, max(1, options.frames // 12)), 3) < 1:
            low = scale
        else:
            high = scale
    scale, best = high, None
    for _ in range(5):
        met = spent(scale, range(options.frames), 1)
        if best is None or abs(met - 1) < abs(best[1] - 1):
            best = scale, met
        following = min(most, max(1.0, scale / met))
        if abs(met - 1) <= MEET or following == scale:
            break
        scale = following
    return best


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mapper", choices=("fixed", "gpu"), default="fixed")
    parser.add_argument("--out", required=True, help="folder for the frames (CSV) and scores (JSON)")
    parser.add_argument("--model", help="model file of the calibrated contender; without it that contender is left out")
    parser.add_argument("--contenders", default="full,auto,between,scaled,cold,calibrated")
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--edge", type=int, default=256, help="voxels along each side")
    parser.add_argument("--size", type=int, default=512, help="pixels along each side")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--clock", choices=("cpu", "wall"), default="cpu", help="clock by which vtkEntireSteering steers")
    options = parser.parse_args()
    names = [n for n in options.contenders.split(",") if n != "calibrated" or options.model]
    if names[0] != "full":
        parser.error("the first contender must be full: the others are compared with it")
    os.makedirs(options.out, exist_ok=True)
    n = options.edge
    image = vtk_scene.image_data(vtk_scene.noise_volume(n))

    probe = Contender("full", options.mapper, image, options.size, options)
    for _ in range(2):
        probe.pose(0, options.frames, n)
        probe.view.window.Render()
    for frame in range(0, options.frames, 10):
        probe.draw(frame, options.frames, n, None)
    target_cpu = 0.5 * statistics.fmean(r["cpu"] for r in probe.rows)
    target_wall = 0.5 * statistics.fmean(r["wall"] for r in probe.rows)
    print(f"{options.mapper}: target {1e3 * target_cpu:.1f} ms processor time, {1e3 * target_wall:.1f} ms wall time")
    probe = None
    scale = 1.0
    if "scaled" in names:
        scale, met = find_scale(options, image, n, target_cpu, target_wall)
        print(f"scaled: desired update rate {1 / scale:.3f} / target, mean frame time {met:.3f} of the target", flush=True)

    scores = {"mapper": options.mapper, "scale": scale, "target_cpu": target_cpu, "target_wall": target_wall, "repeats": []}
    for repeat in range(options.repeats):
        contenders = [Contender(name, options.mapper, image, options.size, options) for name in names]
        for contender in contenders:
            contender.aim(target_cpu, target_wall, options.clock, scale)
        for frame in range(options.frames):
            reference = None
            for contender in contenders:
                pixels = contender.draw(frame, options.frames, n, reference)
                if contender.name == "full":
                    reference = pixels
        result = {}
        for contender in contenders:
            path = os.path.join(options.out, f"{options.mapper}-{contender.name}-{repeat}.csv")
            with open(path, "w", newline="") as file:
                writer = csv.DictWriter(file, contender.rows[0].keys(), lineterminator="\n")
                writer.writeheader()
                writer.writerows(contender.rows)
            result[contender.name] = {
                "cpu": score(contender.rows, contenders[0].rows, "cpu", target_cpu),
                "wall": score(contender.rows, contenders[0].rows, "wall", target_wall),
                "clock": clock_of(contender.name, options),
            }
            observer = [r["observer"] for r in contender.rows if "observer" in r]
            if observer:
                result[contender.name]["observer_us"] = 1e6 * statistics.median(observer)
                steady = [t for i, t in enumerate(observer) if i and contender.rows[i]["tf"] == contender.rows[i - 1]["tf"]]
                result[contender.name]["observer_p95_us"] = 1e6 * sorted(steady)[int(0.95 * len(steady))]
        scores["repeats"].append(result)
        print(f"repeat {repeat}, each by its own clock:")
        for name in names:
            s = result[name][result[name]["clock"]]
            print(
                f"  {name:10} {result[name]['clock']:4} mean {s['mean_ms']:7.1f} ms ({result[name]['wall']['mean_ms']:.1f} wall time)"
                f"  |t-target|/target {s['off']:.3f} (hard frames {s['off_hard']:.3f})"
                f"  >1.25x {100 * s['over']:4.1f} %  <0.75x {100 * s['under']:5.1f} %  worst {s['worst']:.2f}x"
                f"  recovery {s['recovery']}  error {s['error']:.3f}"
                + (f"  observer {result[name]['observer_us']:.0f} us" if "observer_us" in result[name] else "")
            )
        sys.stdout.flush()
        with open(os.path.join(options.out, f"{options.mapper}.json"), "w") as file:
            json.dump(scores, file, indent=1)


if __name__ == "__main__":
    main()
