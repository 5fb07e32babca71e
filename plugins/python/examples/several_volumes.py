# SPDX-License-Identifier: MIT OR Apache-2.0
"""Three volumes in one PyVista scene share the frame time and are coarsened equally.

pip install entire[pyvista]
python several_volumes.py
"""

import numpy as np
import pyvista as pv

n = 72
z, y, x = np.mgrid[-1 : 1 : n * 1j, -1 : 1 : n * 1j, -1 : 1 : n * 1j]
radius = np.sqrt(x**2 + y**2 + z**2)
shapes = (
    np.exp(-60 * (np.sqrt((np.sqrt(x**2 + y**2) - 0.6) ** 2 + z**2) - 0.2) ** 2),
    (0.5 + 0.5 * np.sin(14 * radius)) * (radius < 0.95),
    np.exp(-8 * radius**2) * (1 + np.cos(11 * x) * np.cos(11 * y) * np.cos(11 * z)) / 2,
)

pl = pv.Plotter(window_size=(480, 360))
for i, (shape, cmap) in enumerate(zip(shapes, ("viridis", "plasma", "cividis"))):
    grid = pv.ImageData(dimensions=(n, n, n), origin=((n + 8) * i, 0, 0))
    grid["value"] = (255 * shape).astype(np.uint8).ravel()
    pl.add_volume(grid, cmap=cmap, opacity="linear", show_scalar_bar=False)
steering = pl.entire.hold(fps=8, overlay=True)
# When the window is closed, the steering has no leaves; each leaf keeps its history.
leaves = list(steering.leaves)

if __name__ == "__main__":
    pl.show()
    for leaf in leaves:
        print(leaf.session.history)
