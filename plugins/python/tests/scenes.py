# SPDX-License-Identifier: MIT OR Apache-2.0
"""Volumes in a VTK window, made by modules of the C++ class's tests."""

import math

from vtk_scene import COLOR, MAPPERS, OPAQUE, TRANSPARENT, color_function, image_data, opacity_function, pixels
from vtkmodules.vtkRenderingCore import vtkRenderer, vtkRenderWindow, vtkVolume, vtkVolumeProperty

__all__ = [
    "COLOR",
    "MAPPERS",
    "OPAQUE",
    "TRANSPARENT",
    "View",
    "add_volume",
    "color_function",
    "image_data",
    "one_volume",
    "opacity_function",
]


def add_volume(renderer, voxels, mapper="gpu", points=OPAQUE, spacing=(1.0, 1.0, 1.0)):
    volume = vtkVolume()
    made = MAPPERS[mapper]()
    made.SetInputData(image_data(voxels, spacing))
    if mapper != "smart":
        made.SetAutoAdjustSampleDistances(0)
        made.SetLockSampleDistanceToInputSpacing(0)
        made.SetSampleDistance(1.0)
    volume.SetMapper(made)
    prop = vtkVolumeProperty()
    prop.SetInterpolationTypeToLinear()
    prop.SetScalarOpacity(opacity_function(points))
    prop.SetColor(color_function(COLOR))
    volume.SetProperty(prop)
    renderer.AddVolume(volume)
    return volume


class View:
    """One off-screen window, empty at first."""

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
        """Pixels of the window, uint8 [y, x, rgb], without drawing it again."""
        return pixels(self.window)


def one_volume(voxels, mapper="gpu", **options):
    """A window with one volume; returns both."""
    view = View()
    return view, add_volume(view.renderer, voxels, mapper, **options)


def settings(mapper):
    names = (
        "SampleDistance",
        "ImageSampleDistance",
        "AutoAdjustSampleDistances",
        "LockSampleDistanceToInputSpacing",
    )
    return [getattr(mapper, "Get" + n)() for n in names if hasattr(mapper, "Get" + n)]
