# SPDX-License-Identifier: MIT OR Apache-2.0
"""Volumes in a VTK window."""

import math

import numpy as np
import vtkmodules.vtkInteractionStyle
import vtkmodules.vtkRenderingOpenGL2
import vtkmodules.vtkRenderingVolumeOpenGL2  # noqa: F401
from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
from vtkmodules.vtkCommonDataModel import vtkImageData, vtkPiecewiseFunction
from vtkmodules.vtkRenderingCore import (
    vtkColorTransferFunction,
    vtkRenderer,
    vtkRenderWindow,
    vtkVolume,
    vtkVolumeProperty,
    vtkWindowToImageFilter,
)
from vtkmodules.vtkRenderingVolume import vtkFixedPointVolumeRayCastMapper
from vtkmodules.vtkRenderingVolumeOpenGL2 import vtkOpenGLGPUVolumeRayCastMapper, vtkSmartVolumeMapper

MAPPERS = {
    "fixed": vtkFixedPointVolumeRayCastMapper,
    "gpu": vtkOpenGLGPUVolumeRayCastMapper,
    "smart": vtkSmartVolumeMapper,
}
TRANSPARENT = ((0, 0.0), (20, 0.0), (255, 0.03))
OPAQUE = ((0, 0.0), (20, 0.0), (60, 0.12), (255, 0.5))


def image_data(voxels, spacing=(1.0, 1.0, 1.0)):
    """[z, y, x] voxels as vtkImageData, centered at the origin."""
    image = vtkImageData()
    image.SetDimensions(*voxels.shape[::-1])
    image.SetSpacing(*spacing)
    image.SetOrigin(*(-0.5 * (n - 1) * s for n, s in zip(voxels.shape[::-1], spacing)))
    image.GetPointData().SetScalars(numpy_to_vtk(np.ascontiguousarray(voxels).ravel(), deep=1))
    return image


def add_volume(renderer, voxels, mapper="gpu", points=OPAQUE, spacing=(1.0, 1.0, 1.0)):
    volume = vtkVolume()
    made = MAPPERS[mapper]()
    made.SetInputData(image_data(voxels, spacing))
    if mapper != "smart":
        made.SetAutoAdjustSampleDistances(0)
        made.SetLockSampleDistanceToInputSpacing(0)
        made.SetSampleDistance(1.0)
    volume.SetMapper(made)
    opacity, color = vtkPiecewiseFunction(), vtkColorTransferFunction()
    for at, value in points:
        opacity.AddPoint(at, value)
    color.AddRGBPoint(0, 0.1, 0.1, 0.3)
    color.AddRGBPoint(90, 0.8, 0.3, 0.1)
    color.AddRGBPoint(255, 1, 1, 0.8)
    prop = vtkVolumeProperty()
    prop.SetInterpolationTypeToLinear()
    prop.SetScalarOpacity(opacity)
    prop.SetColor(color)
    volume.SetProperty(prop)
    renderer.AddVolume(volume)
    return volume


class View:
    """One off-screen window."""

    def __init__(self, size=(200, 200)):
        self.renderer = vtkRenderer()
        self.window = vtkRenderWindow()
        self.window.SetOffScreenRendering(1)
        self.window.SetMultiSamples(0)
        self.window.SetSize(*size)
        self.window.AddRenderer(self.renderer)

    def orbit(self, degrees, distance, elevation=20.0):
        a, e = math.radians(degrees), math.radians(elevation)
        camera = self.renderer.GetActiveCamera()
        camera.SetFocalPoint(0, 0, 0)
        camera.SetPosition(
            distance * math.cos(e) * math.sin(a), distance * math.sin(e), distance * math.cos(e) * math.cos(a)
        )
        camera.SetViewUp(0, 1, 0)
        self.renderer.ResetCameraClippingRange()

    def draw(self, frames=1, distance=110.0, start=0.0):
        for i in range(frames):
            self.orbit(start + 3 * i, distance)
            self.window.Render()

    def pixels(self):
        """What the window shows, as [y, x, rgb] bytes, without drawing it again."""
        grab = vtkWindowToImageFilter()
        grab.SetInput(self.window)
        grab.ShouldRerenderOff()
        grab.ReadFrontBufferOff()
        grab.Update()
        out = grab.GetOutput()
        width, height, _ = out.GetDimensions()
        return vtk_to_numpy(out.GetPointData().GetScalars()).reshape(height, width, -1)[:, :, :3].copy()
