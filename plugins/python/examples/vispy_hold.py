# SPDX-License-Identifier: MIT OR Apache-2.0
"""Holds vispy's volume visual to 80 ms per frame while it is turned: drag with the mouse.

pip install entire vispy PyQt6
python vispy_hold.py
"""

import numpy as np
from vispy import app, scene

import entire.vispy

n = 96
z, y, x = np.mgrid[-1 : 1 : n * 1j, -1 : 1 : n * 1j, -1 : 1 : n * 1j]
radius = np.sqrt(x**2 + y**2 + z**2)
wave = (0.6 + 0.4 * np.sin(18 * radius) * np.cos(9 * x) * np.cos(9 * y)) * np.exp(-3 * radius**2)

canvas = scene.SceneCanvas(size=(480, 360), show=True, title="entire.vispy")
view = canvas.central_widget.add_view()
visual = scene.visuals.Volume(
    wave.astype(np.float32), parent=view.scene, method="mip", cmap="viridis"
)
view.camera = scene.cameras.TurntableCamera(
    fov=45, distance=2.2 * n, center=(n / 2, n / 2, n / 2), parent=view.scene
)
holder = entire.vispy.hold(canvas, visual, seconds=0.08)

if __name__ == "__main__":
    app.run()
    print(holder.history)
