# SPDX-License-Identifier: MIT OR Apache-2.0
"""Holds a volume in PyVista to 30 frames per second while it is turned: drag with the mouse.

pip install entire[pyvista]
python three_lines.py
"""

import numpy as np
import pyvista as pv

n = 128
z, y, x = np.mgrid[-1 : 1 : n * 1j, -1 : 1 : n * 1j, -1 : 1 : n * 1j]
wave = np.sin(12 * np.sqrt(x**2 + y**2 + z**2)) * np.cos(9 * x) * np.cos(9 * y)

pl = pv.Plotter(window_size=(480, 360))
pl.add_volume((127 * (1 + wave)).astype(np.uint8), opacity="sigmoid", show_scalar_bar=False)
pl.entire.hold(fps=30, overlay=True)

if __name__ == "__main__":
    pl.show()
    print(pl.entire.history)
