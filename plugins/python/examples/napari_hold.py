# SPDX-License-Identifier: MIT OR Apache-2.0
"""Holds napari's 3D view to 100 ms per frame while it is turned: drag with the mouse.

pip install entire "napari[all]"
python napari_hold.py
"""

import napari
import numpy as np

import entire.napari

n = 96
z, y, x = np.mgrid[-1 : 1 : n * 1j, -1 : 1 : n * 1j, -1 : 1 : n * 1j]
viewer = napari.Viewer(ndisplay=3)
radius = np.sqrt(x**2 + y**2 + z**2)
wave = (0.6 + 0.4 * np.sin(18 * radius) * np.cos(9 * x) * np.cos(9 * y)) * np.exp(-3 * radius**2)
viewer.add_image(wave, rendering="mip", colormap="inferno")
holder = entire.napari.hold(viewer, seconds=0.1)

if __name__ == "__main__":
    napari.run()
    print(holder.history)
