# SPDX-License-Identifier: MIT OR Apache-2.0
"""Draws pictures of a yt scene within 1 second each.

pip install entire yt
python yt_hold.py picture.png
"""

import sys

import numpy as np
import yt

import entire.yt

yt.set_log_level(50)
n = 64
z, y, x = np.mgrid[-1 : 1 : n * 1j, -1 : 1 : n * 1j, -1 : 1 : n * 1j]
density = np.exp(-6 * (x**2 + 2 * y**2 + z**2)) * (1 + 0.5 * np.sin(20 * x) * np.sin(20 * z)) + 1e-3
data = yt.load_uniform_grid(
    {("stream", "density"): density}, (n, n, n), bbox=np.array([[-1.0, 1.0]] * 3), nprocs=1
)
scene = yt.create_scene(data, ("stream", "density"))
source = scene[0]
source.set_log(False)
source.transfer_function = yt.ColorTransferFunction((0.0, 1.6))
source.transfer_function.add_layers(6, w=0.004, colormap="viridis", alpha=np.logspace(0, 1.5, 6))
camera = scene.add_camera(data, lens_type="perspective")
camera.resolution = (256, 256)
camera.position = data.arr([2.2, 1.4, 1.8], "code_length")
camera.focus = data.arr([0.0, 0.0, 0.0], "code_length")
source.num_samples = 10

holder = entire.yt.hold(scene, seconds=1.0)
for degrees in range(0, 90, 10):
    camera.yaw(np.radians(1.0))
    holder.render()
    print(
        f"{holder.samples} samples per cell, {holder.resolution[0]} pixels, {1e3 * holder.measured:.0f} "
        f"ms: {holder.why}"
    )
print(holder.history)
if len(sys.argv) > 1:
    scene.save(sys.argv[1], sigma_clip=4.0, render=False)
