# SPDX-License-Identifier: MIT OR Apache-2.0
"""Steers a VTK volume in Python with three lines.

    PYTHONPATH=build/lib/python3/site-packages xvfb-run -a python3 steer.py [--mapper fixed|gpu|smart] [--target-ms 40]
"""
import argparse
import os
import sys

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import vtk_scene  # noqa: E402
from vtk_scene import COLOR, OPAQUE, TRANSPARENT, camera  # noqa: E402
from entire_vtk.vtkEntireSteering import vtkEntireSteering  # noqa: E402

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--mapper", choices=sorted(vtk_scene.MAPPERS), default="fixed")
parser.add_argument("--target-ms", type=float, default=40.0)
parser.add_argument("--frames", type=int, default=40)
parser.add_argument("--edge", type=int, default=128)
options = parser.parse_args()

view = vtk_scene.View(options.mapper, vtk_scene.image_data(vtk_scene.noise_volume(options.edge)), (400, 400))
color = vtk_scene.color_function(COLOR)
functions = [vtk_scene.opacity_function(points) for points in (TRANSPARENT, OPAQUE)]

steering = vtkEntireSteering()
steering.SetTargetFrameTime(1e-3 * options.target_ms)
steering.Attach(view.renderer, view.volume)

# Update rate that an interactor sets while a mouse button is down; without it, frames are still and never coarsened.
view.window.SetDesiredUpdateRate(15)
for frame in range(options.frames):
    view.functions(functions[frame * 2 // options.frames], color)
    view.camera(camera(frame, options.frames, options.edge))
    view.window.Render()
    print(
        f"frame {frame:3}  predicted {1e3 * steering.GetPredictedTime():7.1f} ms  measured {1e3 * steering.GetMeasuredTime():7.1f} ms"
        f"  whole frame {1e3 * steering.GetFrameTime():7.1f} ms  sample distance {steering.GetSampleDistance():.2f}"
        f"  image {steering.GetImageSampleDistance():.1f}  {steering.GetReason()} {steering.GetStatus() or ''}"
    )
