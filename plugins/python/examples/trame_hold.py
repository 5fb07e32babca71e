# SPDX-License-Identifier: MIT OR Apache-2.0
"""Shows a PyVista volume in the browser. The server draws and encodes 20 pictures per second.

pip install entire[pyvista] trame-pyvista
python trame_hold.py --server --port 8080
"""

import numpy as np
import pyvista as pv
from trame.app import get_server
from trame.ui.vuetify3 import SinglePageLayout
from trame_pyvista.ui import plotter_ui

n = 96
z, y, x = np.mgrid[-1 : 1 : n * 1j, -1 : 1 : n * 1j, -1 : 1 : n * 1j]
wave = np.sin(12 * np.sqrt(x**2 + y**2 + z**2)) * np.cos(9 * x) * np.cos(9 * y)

pl = pv.Plotter(off_screen=True, window_size=(480, 360))
pl.add_volume((127 * (1 + wave)).astype(np.uint8), opacity="sigmoid", show_scalar_bar=False)
# Frames are steered while the browser's mouse moves the scene: in trame the plotter has an interactor.
steering = pl.entire.hold(fps=20, overlay=True)

server = get_server()
with SinglePageLayout(server) as layout:
    layout.title.set_text("20 pictures per second")
    with layout.content:
        plotter_ui(pl, mode="server")

if __name__ == "__main__":
    server.start()
    print(steering.history)
    print(f"encoding takes {1e3 * steering.outside_time:.1f} ms of a frame")
