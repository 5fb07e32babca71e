# SPDX-License-Identifier: MIT OR Apache-2.0
"""Timing tables of VTK's volume mappers, as `entire collect` writes them of its own raycaster.

    xvfb-run -a python3 collect_vtk.py --mapper fixed --out fixed.csv --max-size 256 VOLUME.nrrd...
    entire train --data fixed.csv --clock cpu --out fixed.safetensors

Timed is the mapper's work, from its VolumeMapperRenderStartEvent to its VolumeMapperRenderEndEvent: what
vtkEntireSteering predicts. `seconds_cpu` is processor time of the process, llvmpipe's threads included.
"""
import os
import sys
import time

import numpy as np

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import timing_table  # noqa: E402
import vtk_scene  # noqa: E402
from vtkmodules.vtkCommonCore import vtkVersion  # noqa: E402


class VtkRenderer:
    warm_up = 1

    def __init__(self, mapper, shade):
        self.mapper, self.shade = mapper, shade
        self.name = {"fixed": "vtk-fixed-point", "gpu": "vtk-gpu"}[mapper]
        # What the mappers do by themselves: the fixed-point mapper leaps over blocks without opacity.
        self.skipping = {"fixed": "blocks", "gpu": "none"}[mapper]
        self.termination = {"fixed": 0.99, "gpu": 0.996}[mapper]
        self.driver = vtkVersion.GetVTKVersionFull() if hasattr(vtkVersion, "GetVTKVersionFull") else vtkVersion.GetVTKVersion()
        self.device = "CPU"
        self.view = None

    def load(self, volume):
        self.volume = volume
        image = vtk_scene.image_data(volume.voxels, volume.spacing)
        self.view = vtk_scene.View(self.mapper, image, (64, 64), volume.reference_step)
        self.view.property.SetShade(self.shade == "local")
        self.color = vtk_scene.color_function(((0, 0.1, 0.2, 0.6), (128, 0.9, 0.5, 0.2), (255, 1.0, 1.0, 0.9)))
        self.started = self.taken = None
        self.view.mapper.AddObserver("VolumeMapperRenderStartEvent", self._start)
        self.view.mapper.AddObserver("VolumeMapperRenderEndEvent", self._end)

    def _start(self, *_):
        self.started = (time.perf_counter(), time.process_time())

    def _end(self, *_):
        wall, cpu = time.perf_counter(), time.process_time()
        self.taken = (wall - self.started[0], cpu - self.started[1])

    def prepare(self, scene):
        view, volume = self.view, self.volume
        view.adjust_off(scene.step * volume.reference_step)
        view.window.SetSize(scene.width, scene.height)
        opacity = scene.opacity()
        at = np.linspace(0.0, 255.0, opacity.size)
        view.functions(vtk_scene.opacity_function(zip(at, opacity)), self.color)
        toward, up = scene.eye()
        view.camera([scene.dz * volume.radius * c for c in toward], up, scene.fov_y)

        def draw():
            view.window.Render()
            return self.taken

        return draw


if __name__ == "__main__":
    parser = timing_table.arguments(__doc__.splitlines()[0])
    parser.add_argument("--mapper", choices=("fixed", "gpu"), default="fixed")
    options = parser.parse_args()
    timing_table.collect(options, VtkRenderer(options.mapper, options.shade))
