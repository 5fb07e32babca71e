# SPDX-License-Identifier: MIT OR Apache-2.0
"""Writes timing tables of VTK's volume mappers, in the format of `entire collect`.

    xvfb-run -a python3 collect_vtk.py --mapper fixed --out fixed.csv --max-size 256 VOLUME.nrrd...
    entire calibrate --data fixed.csv --clock cpu --out fixed.safetensors

With --pictures FILE, some scenes of each volume are then drawn with several pairs of sample distance and image sample
distance and compared with full quality (root mean square difference of 8-bit colors). `entire calibrate --data
fixed.csv --pictures FILE` fits the mapper's quality law to this table and stores it in the model, where
vtkEntireSteering finds it.

The times are those of the mapper's work, from its VolumeMapperRenderStartEvent to its VolumeMapperRenderEndEvent, which
vtkEntireSteering predicts. `seconds_cpu` is processor time of the process, including llvmpipe's threads.
"""
import csv
import os
import sys
import time

import numpy as np

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import timing_table  # noqa: E402
import vtk_scene  # noqa: E402
from vtkmodules.vtkCommonCore import vtkVersion  # noqa: E402


# Sample distances (as multiples of the finest) and image sample distances of the pictures that are compared with full
# quality.
STEPS = (1.0, 1.3, 1.7, 2.2, 3.0, 4.0)
IMAGES = (1.0, 1.2, 1.44, 2.0)

# Smallest image side in a comparison, in pixels; smaller images give no reliable errors.
LEAST_SIDE = 256


class VtkRenderer:
    warm_up = 1

    def __init__(self, mapper, shade):
        self.mapper, self.shade = mapper, shade
        # The renderer name that vtkEntireSteering uses: a model's quality law is valid only for the renderer it names.
        self.name = vtk_scene.MAPPERS[mapper]().GetClassName()
        # Empty-space skipping of the mappers: the fixed-point mapper skips transparent blocks.
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


def compared(renderer, scene, name, repeats):
    """Draws a scene at every pair of step and image sample distance; returns rows of the table of pictures."""
    draw = renderer.prepare(scene)
    found = vtk_scene.compared(renderer.view, draw, scene.step * renderer.volume.reference_step, IMAGES, STEPS, repeats)
    rows = [(name, step, image, float(np.median(seconds)), error) for image, step, seconds, error in found]
    renderer.view.mapper.SetImageSampleDistance(1.0)
    return rows


def compare(options, renderer):
    """Writes the table of compared pictures after each scene, so that an interruption keeps the finished scenes."""
    with open(options.pictures, "x", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("scene", "step", "image_sample_distance", "seconds", "error"))
        for path in options.volumes:
            renderer.load(timing_table.drawn_volume(options, path))
            for index in range(options.scenes):
                # Indices after those of the timed frames give other scenes.
                scene = timing_table.draw_scene(
                    options.seed, renderer.volume.seed_name(), options.frames + index,
                    max(LEAST_SIDE, options.min_size), max(LEAST_SIDE, options.max_size),
                )
                writer.writerows(compared(renderer, scene, f"{path} {index}", options.repeats))
                file.flush()
                print(f"{path}: {index + 1} of {options.scenes} scenes compared", file=sys.stderr)


if __name__ == "__main__":
    parser = timing_table.arguments(__doc__.splitlines()[0])
    parser.add_argument("--mapper", choices=("fixed", "gpu"), default="fixed")
    parser.add_argument("--pictures", metavar="FILE.csv", help="also compare pictures and write their table here")
    parser.add_argument("--scenes", type=int, default=4, help="scenes per volume whose pictures are compared")
    options = parser.parse_args()
    if options.pictures and os.path.exists(options.pictures):
        sys.exit(f"{options.pictures} exists already; remove it or choose another name")
    renderer = VtkRenderer(options.mapper, options.shade)
    timing_table.collect(options, renderer)
    if options.pictures:
        compare(options, renderer)
