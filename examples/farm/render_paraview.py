# SPDX-License-Identifier: MIT OR Apache-2.0
"""Renders tasks of `entire farm` with ParaView. A job selects this script by `[renderer]` with `kind = "pvbatch"` and
`script = "render_paraview.py"`.

Reads one task per line of standard input and writes one answer per line to standard output, both as JSON. The volume
stays loaded while tasks name the same file. A camera is an arcball pose: a rotation about x, then about y, in degrees,
and a distance in radii of the volume's bounding sphere."""

import json
import math
import os
import time

from paraview import simple

EXP_POINTS = 64
VTK_UNSIGNED_CHAR = 3


def opacity(transfer):
    """Returns points (position, red, green, blue, opacity) of a transfer function."""
    if "points" in transfer:
        return [(p["position"], *p["color"], p["opacity"]) for p in transfer["points"]]
    out = []
    for i in range(EXP_POINTS):
        s = i / (EXP_POINTS - 1)
        height = sum(l["height"] * math.exp(-((s - l["center"]) ** 2) / l["width"]) for l in transfer["lobes"])
        out.append((s, s, 0.5, 1.0 - s, min(height, 1.0)))
    return out


class Scene:
    def __init__(self):
        simple._DisableFirstRenderCameraReset()
        self.view = simple.CreateView("RenderView")
        self.view.OrientationAxesVisibility = 0
        self.view.UseColorPaletteForBackground = 0
        self.view.Background = [0.0, 0.0, 0.0]
        self.loaded = None
        self.source = None

    def load(self, path, reading):
        # If loading fails, the next task loads its volume again.
        self.loaded = None
        if self.source is not None:
            simple.Delete(self.source)
            self.source = None
        self.source = simple.OpenDataFile(path)
        self.source.UpdatePipeline()
        information = self.source.GetPointDataInformation()
        name = reading.get("array")
        self.array = information.GetArray(name if name else 0)
        if self.array is None:
            raise ValueError(f"{path} has no point array {name or 0}")
        if reading.get("fill") not in (None, "auto", "none"):
            raise ValueError(f"fill is {reading['fill']}; this script accepts only none and auto")
        self.display = simple.Show(self.source, self.view)
        self.display.SetRepresentationType("Volume")
        simple.ColorBy(self.display, ("POINTS", self.array.GetName()))
        self.loaded = (path, name)

    def scalar_range(self, text):
        """Returns the scalar values that map to 0 and 1; `text` is `auto`, `data`, or two numbers."""
        if text == "auto" and self.array.GetDataType() == VTK_UNSIGNED_CHAR:
            return 0.0, 255.0
        return self.array.GetRange() if text in ("auto", "data") else map(float, text.split(","))

    def draw(self, task):
        begin = time.perf_counter()
        load_s = 0.0
        if (task["volume"], task["reading"].get("array")) != self.loaded:
            self.load(task["volume"], task["reading"])
            load_s = time.perf_counter() - begin
        low, high = self.scalar_range(task["reading"]["range"])
        points = opacity(task["transfer"])
        colors = simple.GetColorTransferFunction(self.array.GetName())
        opacities = simple.GetOpacityTransferFunction(self.array.GetName())
        colors.RGBPoints = [v for s, r, g, b, _ in points for v in (low + s * (high - low), r, g, b)]
        opacities.Points = [v for s, _, _, _, o in points for v in (low + s * (high - low), o, 0.5, 0.0)]
        bounds = self.source.GetDataInformation().GetBounds()
        center = [(bounds[2 * a] + bounds[2 * a + 1]) / 2 for a in range(3)]
        radius = math.dist(bounds[::2], bounds[1::2]) / 2
        rx, ry = (math.radians(v) for v in task["camera"][:2])
        away = task["camera"][2] * radius
        direction = [math.cos(rx) * math.sin(ry), math.sin(rx), math.cos(rx) * math.cos(ry)]
        up = [-math.sin(rx) * math.sin(ry), math.cos(rx), -math.sin(rx) * math.cos(ry)]
        self.view.CameraFocalPoint = center
        self.view.CameraPosition = [c + away * d for c, d in zip(center, direction)]
        self.view.CameraViewUp = up
        self.view.CameraViewAngle = task["fov_y_deg"]
        self.view.ViewSize = task["size"]
        simple.Render(self.view)
        simple.SaveScreenshot(task["out"], self.view, ImageResolution=task["size"])
        return {"task": task["task"], "load_s": load_s, "seconds": time.perf_counter() - begin - load_s}


# ParaView replaces sys.stdin and sys.stdout by its own objects.
tasks, answers = os.fdopen(0), os.fdopen(os.dup(1), "w")
scene = Scene()
for line in tasks:
    task = json.loads(line)
    try:
        answer = scene.draw(task)
    except Exception as error:
        answer = {"task": task["task"], "error": f"{type(error).__name__}: {error}"}
    print(json.dumps(answer), file=answers, flush=True)
