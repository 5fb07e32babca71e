# SPDX-License-Identifier: MIT OR Apache-2.0
"""Holds a volume of plain VTK to 20 ms per frame off screen and writes the history to history.svg.

pip install entire[vtk]
xvfb-run -a python vtk_hold.py
"""

import math
import sys

import numpy as np
import vtkmodules.vtkInteractionStyle
import vtkmodules.vtkRenderingOpenGL2
import vtkmodules.vtkRenderingVolumeOpenGL2  # noqa: F401
from vtkmodules.util.numpy_support import numpy_to_vtk
from vtkmodules.vtkCommonDataModel import vtkImageData, vtkPiecewiseFunction
from vtkmodules.vtkRenderingCore import vtkColorTransferFunction, vtkRenderer, vtkRenderWindow, vtkVolume
from vtkmodules.vtkRenderingVolumeOpenGL2 import vtkSmartVolumeMapper

import entire.vtk

n = 96
z, y, x = np.mgrid[-1 : 1 : n * 1j, -1 : 1 : n * 1j, -1 : 1 : n * 1j]
voxels = (127 * (1 + np.sin(12 * np.sqrt(x**2 + y**2 + z**2)) * np.cos(9 * x) * np.cos(9 * y))).astype(
    np.uint8
)
image = vtkImageData()
image.SetDimensions(n, n, n)
image.GetPointData().SetScalars(numpy_to_vtk(voxels.ravel()))
mapper, volume, renderer, window = vtkSmartVolumeMapper(), vtkVolume(), vtkRenderer(), vtkRenderWindow()
mapper.SetInputData(image)
volume.SetMapper(mapper)
opacity, color = vtkPiecewiseFunction(), vtkColorTransferFunction()
for at, value in ((0, 0), (140, 0), (255, 0.4)):
    opacity.AddPoint(at, value)
color.AddRGBPoint(0, 0.1, 0.2, 0.5)
color.AddRGBPoint(255, 1, 0.9, 0.7)
volume.GetProperty().SetScalarOpacity(opacity)
volume.GetProperty().SetColor(color)
renderer.AddVolume(volume)
window.SetOffScreenRendering(1)
window.SetSize(480, 360)
window.AddRenderer(renderer)
renderer.ResetCamera()

steering = entire.vtk.hold(renderer, volume, seconds=0.02)
for frame in range(80):
    renderer.GetActiveCamera().Azimuth(2)
    renderer.GetActiveCamera().Zoom(1 + 0.01 * math.sin(frame / 8))
    renderer.ResetCameraClippingRange()
    window.Render()
print(steering)
print(steering.history)
with open(sys.argv[1] if len(sys.argv) > 1 else "history.svg", "w") as file:
    file.write(steering.history.svg())
