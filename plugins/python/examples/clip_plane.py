# SPDX-License-Identifier: MIT OR Apache-2.0
"""Clips a volume by a plane within a frame time: drag the plane's arrow, or the scene beside it.

pip install entire[pyvista]
python clip_plane.py
"""

import numpy as np
import pyvista as pv

n = 112
z, y, x = np.mgrid[-1 : 1 : n * 1j, -1 : 1 : n * 1j, -1 : 1 : n * 1j]
shells = (0.5 + 0.5 * np.sin(16 * np.sqrt(x**2 + y**2 + z**2))) * (np.sqrt(x**2 + y**2 + z**2) < 1)

pl = pv.Plotter(window_size=(480, 360))
volume = pl.add_volume((255 * shells).astype(np.uint8), opacity="linear", show_scalar_bar=False)
# Hold before clipping: hold() may replace the mapper, and the plane is set on the mapper that draws.
pl.entire.hold(fps=12, overlay=True)
pl.add_volume_clip_plane(volume, normal="-x")

if __name__ == "__main__":
    pl.show()
    print(pl.entire.history)
