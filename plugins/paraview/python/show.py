# SPDX-License-Identifier: MIT OR Apache-2.0
"""Shows a volume in the graphical client, for the screenshot."""
import os
import sys

if os.environ.get("PARAVIEW_MODULES"):
    sys.path.insert(0, os.environ["PARAVIEW_MODULES"])
from paraview.simple import *  # noqa: F401,F403

edge = 90
source = Wavelet(WholeExtent=[-edge, edge] * 3)
view = GetActiveViewOrCreate("RenderView")
display = Show(source, view)
display.SetRepresentationType("Volume")
ColorBy(display, ("POINTS", "RTData"))
ResetCamera(view)
view.GetActiveCamera().Azimuth(30)
view.GetActiveCamera().Elevation(20)
Render(view)
print("shown", flush=True)
