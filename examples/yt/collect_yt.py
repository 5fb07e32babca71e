# SPDX-License-Identifier: MIT OR Apache-2.0
"""Writes timing tables of yt's volume rendering on the CPU, in the format of `entire collect`.

    python3 -m venv venv && venv/bin/pip install yt
    venv/bin/python collect_yt.py --out yt.csv --max-size 128 VOLUME.nrrd...
    entire train --data yt.csv --clock cpu --out yt.safetensors

yt's ColorTransferFunction uses the same formula for Gaussian lobes as `entire collect`. yt takes a whole number of
samples in every cell that a ray crosses. A step of --steps must be 1 / a whole number, which becomes the number of
samples per cell. The table contains the resulting mean distance between samples, which depends on the view direction
and the spacing. yt neither skips empty space nor stops opaque rays. It runs on one thread, since waiting threads would
count as processor time. OMP_NUM_THREADS sets another number of threads.
"""
import math
import os
import platform
import sys

os.environ.setdefault("OMP_NUM_THREADS", "1")
import numpy as np
import yt

HERE = os.path.dirname(os.path.abspath(__file__))
sys.path.insert(0, os.path.join(HERE, "..", "..", "plugins", "vtk", "python"))
import timing_table  # noqa: E402


def mean_cell_chord(scene, spacing, side=16):
    """Returns the mean length of a ray inside a cell, in the unit of `spacing`, over side x side rays of the image. A
    ray of direction d crosses sum(|d_i| / spacing_i) cells per unit of length."""
    toward, up = (np.array(v) for v in scene.eye())
    forward, right = -toward, np.cross(up, toward)
    half = math.tan(math.radians(0.5 * scene.fov_y))
    at = (np.arange(side) + 0.5) / side * 2 - 1
    x, y = np.meshgrid(at * half * scene.width / scene.height, at * half)
    rays = forward + x[..., None] * right + y[..., None] * up
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    return 1.0 / float(np.mean(np.sum(np.abs(rays) / np.array(spacing), axis=-1)))


class YtRenderer:
    name, skipping, termination, warm_up = "yt", "none", 1.0, 1

    def __init__(self, shade):
        if shade != "none":
            sys.exit("yt draws without shading; use --shade none")
        self.device = platform.processor() or "CPU"
        self.driver = f"yt {yt.__version__}"

    def load(self, volume):
        self.volume = volume
        x, y, z = volume.dims
        half = [0.5 * n * s for n, s in zip(volume.dims, volume.spacing)]
        values = np.ascontiguousarray(volume.voxels.transpose(2, 1, 0), np.float64) / 255.0
        self.data = yt.load_uniform_grid(
            {("stream", "scalar"): values}, (x, y, z), length_unit=1.0, bbox=np.array([[-h, h] for h in half]), nprocs=1
        )

    def prepare(self, scene):
        volume = self.volume
        drawn = yt.create_scene(self.data, ("stream", "scalar"))
        source = drawn[0]
        source.set_log(False)
        source.set_use_ghost_zones(False)
        source.num_samples = max(1, round(1.0 / scene.step))
        if abs(source.num_samples * scene.step - 1.0) > 1e-6:
            sys.exit(f"yt has no step of {scene.step}; use 1, 0.5, 0.25, ...")
        scene.step = mean_cell_chord(scene, volume.spacing) / volume.reference_step / source.num_samples
        functions = yt.ColorTransferFunction((0.0, 1.0))
        for center, width, height in scene.lobes:
            functions.add_gaussian(center, width, [1.0, 0.7, 0.4, height])
        source.transfer_function = functions
        camera = drawn.add_camera(self.data, lens_type="perspective")
        camera.resolution = (scene.width, scene.height)
        toward, up = scene.eye()
        unit = self.data.arr(1.0, "code_length")
        camera.focus = self.data.arr([0.0, 0.0, 0.0], "code_length")
        camera.set_position(unit * np.array(toward) * scene.dz * volume.radius, north_vector=np.array(up))
        height = 2.0 * math.tan(math.radians(0.5 * scene.fov_y))
        camera.set_width(unit * np.array([height * scene.width / scene.height, height, 1.0]))
        return lambda: timing_table.timed(drawn.render)


if __name__ == "__main__":
    yt.set_log_level(50)
    options = timing_table.arguments(__doc__.splitlines()[0]).parse_args()
    timing_table.collect(options, YtRenderer(options.shade))
