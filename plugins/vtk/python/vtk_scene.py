# SPDX-License-Identifier: MIT OR Apache-2.0
"""A volume, its window and its transfer function in VTK, for lab/scripts/vtk, the collector and the tests."""
import math

import numpy as np
import vtkmodules.vtkInteractionStyle  # noqa: F401  (object factories)
import vtkmodules.vtkRenderingOpenGL2  # noqa: F401
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

from vtk_noise import noise_volume  # noqa: F401  (other scripts import the function from here)

MAPPERS = {
    "fixed": vtkFixedPointVolumeRayCastMapper,
    "gpu": vtkOpenGLGPUVolumeRayCastMapper,
    "smart": vtkSmartVolumeMapper,
}

# Transfer functions of lab/scripts/vtk/compare.py and of steer.py.
COLOR = ((0, 0.1, 0.1, 0.3), (90, 0.8, 0.3, 0.1), (255, 1.0, 1.0, 0.8))
TRANSPARENT = ((0, 0.0), (20, 0.0), (255, 0.03))
OPAQUE = ((0, 0.0), (20, 0.0), (60, 0.12), (255, 0.5))


def camera(frame, frames, n):
    """Position of the eye in frame `frame` of `frames` on an orbit, in voxels from the center of n x n x n voxels."""
    t = frame / frames
    azimuth = 2 * math.pi * t
    elevation = math.radians(25) * math.sin(4 * math.pi * t)
    distance = n * (2.1 + 0.4 * math.cos(2 * math.pi * (t - 0.875)))
    return (
        distance * math.cos(elevation) * math.sin(azimuth),
        distance * math.sin(elevation),
        distance * math.cos(elevation) * math.cos(azimuth),
    )


def image_data(voxels, spacing=(1.0, 1.0, 1.0)):
    """[z, y, x] bytes as vtkImageData, centered at the origin."""
    image = vtkImageData()
    image.SetDimensions(*voxels.shape[::-1])
    image.SetSpacing(*spacing)
    image.SetOrigin(*(-0.5 * (n - 1) * s for n, s in zip(voxels.shape[::-1], spacing)))
    image.GetPointData().SetScalars(numpy_to_vtk(np.ascontiguousarray(voxels).ravel(), deep=1))
    return image


def opacity_function(points):
    """(scalar, opacity) pairs as vtkPiecewiseFunction."""
    function = vtkPiecewiseFunction()
    for at, value in points:
        function.AddPoint(at, value)
    return function


def color_function(points):
    function = vtkColorTransferFunction()
    for at, red, green, blue in points:
        function.AddRGBPoint(at, red, green, blue)
    return function


def pixels(window):
    """Pixels of a window, as [y, x, rgb] bytes, without drawing it again."""
    grab = vtkWindowToImageFilter()
    grab.SetInput(window)
    grab.ShouldRerenderOff()
    grab.ReadFrontBufferOff()
    grab.Update()
    out = grab.GetOutput()
    width, height, _ = out.GetDimensions()
    return vtk_to_numpy(out.GetPointData().GetScalars()).reshape(height, width, -1)[:, :, :3].copy()


def rmse(picture, full):
    """Root mean square difference of two pictures' 8-bit colors."""
    return float(np.sqrt(np.mean((picture.astype(np.float32) - full) ** 2)))


def compared(view, draw, finest, images, steps, repeats):
    """Draws a scene at every pair of image sample distance and step (a multiple of the finest sample distance), and
    compares each picture with the first, which has full quality. Yields image sample distance, step, processor seconds
    of the repeats, and error. `draw` returns wall and processor seconds."""
    full = None
    for image in images:
        for step in steps:
            view.mapper.SetSampleDistance(step * finest)
            view.mapper.SetImageSampleDistance(image)
            # The first frame creates buffers and tables, so its time is dropped.
            seconds = [draw()[1] for _ in range(1 + repeats)][1:]
            picture = view.pixels()
            full = picture if full is None else full
            yield image, step, seconds, rmse(picture, full)


class View:
    """One window with one volume in it."""

    def __init__(self, mapper, image, size=(512, 512), unit_distance=1.0):
        self.mapper = MAPPERS[mapper]() if isinstance(mapper, str) else mapper
        self.mapper.SetInputData(image)
        self.property = vtkVolumeProperty()
        self.property.SetInterpolationTypeToLinear()
        self.property.SetScalarOpacityUnitDistance(unit_distance)
        self.volume = vtkVolume()
        self.volume.SetMapper(self.mapper)
        self.volume.SetProperty(self.property)
        self.renderer = vtkRenderer()
        self.window = vtkRenderWindow()
        self.window.SetOffScreenRendering(1)
        self.window.SetMultiSamples(0)
        self.window.SetSize(*size)
        self.window.AddRenderer(self.renderer)
        self.renderer.AddVolume(self.volume)

    def adjust_off(self, sample_distance=1.0):
        """Turns VTK's automatic adjustment off and sets the sample distance."""
        self.mapper.SetAutoAdjustSampleDistances(0)
        if hasattr(self.mapper, "SetLockSampleDistanceToInputSpacing"):
            self.mapper.SetLockSampleDistanceToInputSpacing(0)
        self.mapper.SetSampleDistance(sample_distance)

    def functions(self, opacity, color):
        self.property.SetScalarOpacity(opacity)
        self.property.SetColor(color)

    def camera(self, position, up=(0, 1, 0), fov_y=45.0):
        camera = self.renderer.GetActiveCamera()
        camera.SetViewAngle(fov_y)
        camera.SetFocalPoint(0, 0, 0)
        camera.SetPosition(*position)
        camera.SetViewUp(*up)
        self.renderer.ResetCameraClippingRange()

    def pixels(self):
        """Pixels of the window, as [y, x, rgb] bytes, without drawing it again."""
        return pixels(self.window)
