# SPDX-License-Identifier: MIT OR Apache-2.0
"""Volume mappers: those that can be steered, their settings, and replacements for those that cannot."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from vtkmodules.vtkRenderingVolumeOpenGL2 import vtkOpenGLGPUVolumeRayCastMapper, vtkSmartVolumeMapper

from .._core import CannotSteer

# Mean number of voxels along an axis below which VTK samples volumes more finely.
_SMALL = 100.0


def spacing_adjusted(image: Any) -> float:
    """The sample distance of mappers that are locked to their input's spacing: half the mean spacing, less in small
    volumes.

    Parameters
    ----------
    image : vtkImageData

    Returns
    -------
    float
        In the unit of the spacing.
    """
    spacing, extent = image.GetSpacing(), image.GetExtent()
    distance = float(sum(spacing)) / 6.0
    cells = (extent[1] - extent[0]) * (extent[3] - extent[2]) * (extent[5] - extent[4])
    mean = float(cells) ** 0.333
    if mean < _SMALL:
        distance *= 0.01 + (1 - 0.01) * mean / _SMALL
    return distance


def full_quality(own: Settings, image: Any, placed: Sequence[float], gpu: bool) -> float:
    """The sample distance of a mapper's own still frames.

    Parameters
    ----------
    own : Settings
        The mapper's own settings.
    image : vtkImageData
        The mapper's input.
    placed : sequence of float
        The volume's matrix, 16 elements, row by row.
    gpu : bool
        True for VTK's GPU mapper. With AutoAdjustSampleDistances it uses the smallest spacing after the volume's
        matrix instead of its sample distance.

    Returns
    -------
    float
        In the unit of the spacing.
    """
    if gpu and own.adjust:
        return min(
            float(abs(side)) * math.hypot(placed[axis], placed[4 + axis], placed[8 + axis])
            for axis, side in enumerate(image.GetSpacing())
        )
    return spacing_adjusted(image) if own.lock else own.sample


class Settings:
    """The application's values of the mapper settings that steering changes."""

    __slots__ = ("adjust", "image", "lock", "sample")

    def __init__(self, mapper: Any) -> None:
        self.sample: float = mapper.GetSampleDistance()
        self.image: float = mapper.GetImageSampleDistance()
        self.adjust: int = mapper.GetAutoAdjustSampleDistances()
        self.lock: int = mapper.GetLockSampleDistanceToInputSpacing()

    def write(self, mapper: Any, image: float) -> None:
        """Restores the settings; `image` is the image sample distance that steering wrote."""
        if self.adjust:
            mapper.SetAutoAdjustSampleDistances(self.adjust)
        if self.lock:
            mapper.SetLockSampleDistanceToInputSpacing(self.lock)
        mapper.SetSampleDistance(self.sample)
        if image != self.image:
            mapper.SetImageSampleDistance(self.image)

    def restore(self, mapper: Any, sample: float, image: float) -> None:
        """Restores the settings, except those that were changed since steering wrote `sample` and `image`."""
        if self.adjust and not mapper.GetAutoAdjustSampleDistances():
            mapper.SetAutoAdjustSampleDistances(self.adjust)
        if self.lock and not mapper.GetLockSampleDistanceToInputSpacing():
            mapper.SetLockSampleDistanceToInputSpacing(self.lock)
        # VTK stores the distances in single precision.
        if math.isclose(mapper.GetSampleDistance(), sample, rel_tol=1e-6):
            mapper.SetSampleDistance(self.sample)
        if math.isclose(mapper.GetImageSampleDistance(), image, rel_tol=1e-6):
            mapper.SetImageSampleDistance(self.image)


def write(mapper: Any, own: Settings, sample: float, image: float) -> None:
    """Sets both distances, and turns automatic adjustment and lock off if they are on."""
    if own.adjust:
        mapper.SetAutoAdjustSampleDistances(0)
    if own.lock:
        mapper.SetLockSampleDistanceToInputSpacing(0)
    mapper.SetSampleDistance(sample)
    if image != own.image:
        mapper.SetImageSampleDistance(image)


def is_gpu(mapper: Any) -> bool:
    return bool(mapper.IsA("vtkGPUVolumeRayCastMapper"))


def is_fixed_point(mapper: Any) -> bool:
    return bool(mapper.IsA("vtkFixedPointVolumeRayCastMapper"))


def refusal(mapper: Any) -> str:
    """Reason why a mapper cannot be steered; empty if it can, or can be replaced."""
    if mapper is None:
        return "the volume has no mapper; give it one before it is held"
    if is_gpu(mapper) or is_fixed_point(mapper):
        return ""
    name = mapper.GetClassName()
    if mapper.IsA("vtkSmartVolumeMapper"):
        return _smart_refusal(mapper)
    if mapper.IsA("vtkMultiBlockVolumeMapper"):
        return (
            f"{name} gives Python no access to the mappers of its blocks, so nothing can be set on them; "
            f"add each block as a "
            "volume of its own (pyvista's add_volume does so), or use the C++ class vtkEntireSteering"
        )
    if mapper.IsA("vtkUnstructuredGridVolumeMapper"):
        return (
            f"{name} draws an unstructured grid, whose frame time cannot be predicted; resample the grid to "
            f"vtkImageData "
            "(vtkResampleToImage, or pyvista's sample_over_bounds) and draw that"
        )
    if mapper.IsA("vtkAnariVolumeMapper") or mapper.IsA("vtkOSPRayVolumeMapper"):
        return (
            f"{name} draws outside of VTK and has no sample distance; steer with entire.Session around its "
            f"frames"
        )
    return (
        f"{name} cannot be steered; vtkOpenGLGPUVolumeRayCastMapper, vtkFixedPointVolumeRayCastMapper and "
        "vtkSmartVolumeMapper can"
    )


def _smart_refusal(smart: Any) -> str:
    """Reason why a GPU mapper cannot replace a smart mapper with its current settings; empty if it can."""
    kind = vtkSmartVolumeMapper
    mode = smart.GetRequestedRenderMode()
    # VTK before 9.4 has no ANARI, and before 9.3 no low-resolution mode.
    outside = {kind.OSPRayRenderMode: "OSPRay", getattr(kind, "AnariRenderMode", -1): "ANARI"}.get(mode)
    if outside:
        return (
            f"the vtkSmartVolumeMapper is told to draw by {outside}, which has no sample distance that could "
            "be set; choose the default mode, or steer with entire.Session around its frames"
        )
    if mode not in (kind.DefaultRenderMode, kind.GPURenderMode):
        return (
            f"the vtkSmartVolumeMapper was told to draw in mode {mode}, and gives Python no access to the "
            f"mapper inside; use "
            "vtkFixedPointVolumeRayCastMapper (pyvista: mapper='fixed_point') or the default mode"
        )
    if hasattr(smart, "GetLowResMode") and smart.GetLowResMode() != kind.LowResModeDisabled:
        return (
            "the vtkSmartVolumeMapper may draw a resampled volume (LowResMode), with a mapper inside to which Python has "
            "no access; switch that mode off, or use the C++ class vtkEntireSteering"
        )
    if smart.GetVectorMode() >= 0 and smart.GetVectorMode() != kind.DISABLED:
        return (
            "the vtkSmartVolumeMapper draws a vector's magnitude or component, which only its inner mapper can do; draw "
            "an array of that magnitude or component instead"
        )
    return ""


def _copy(source: Any, target: Any, names: tuple[str, ...]) -> None:
    for name in names:
        get, put = getattr(source, "Get" + name, None), getattr(target, "Set" + name, None)
        value = None if get is None else get()
        if value is not None and put is not None:
            put(value)


def copy_changed(source: Any, target: Any) -> None:
    """Copies what applications change while a volume is shown: input, cropping, clipping planes, blend mode."""
    if source.GetNumberOfInputConnections(0):
        target.SetInputConnection(source.GetInputConnection(0, 0))
    _copy(source, target, ("Cropping", "CroppingRegionFlags", "CroppingRegionPlanes", "BlendMode"))
    planes = source.GetClippingPlanes()
    if planes is not None:
        target.SetClippingPlanes(planes)
    else:
        target.RemoveAllClippingPlanes()


def gpu_in_place_of(smart: Any, make: Any = vtkOpenGLGPUVolumeRayCastMapper) -> Any:
    """Makes a GPU mapper that draws the same pixels as a smart mapper that draws on the GPU.

    Parameters
    ----------
    smart : vtkSmartVolumeMapper
    make : callable, optional
        Makes the mapper.

    Returns
    -------
    vtkOpenGLGPUVolumeRayCastMapper

    Raises
    ------
    CannotSteer
        If a GPU mapper cannot replace the smart mapper with its current settings.
    """
    why = _smart_refusal(smart)
    if why:
        raise CannotSteer(why)
    gpu = make()
    if smart.GetNumberOfInputConnections(0):
        gpu.SetInputConnection(smart.GetInputConnection(0, 0))
    _copy(
        smart,
        gpu,
        (
            "BlendMode",
            "AverageIPScalarRange",
            "Cropping",
            "CroppingRegionPlanes",
            "CroppingRegionFlags",
            "ClippingPlanes",
            "FinalColorWindow",
            "FinalColorLevel",
            "MaxMemoryInBytes",
            "MaxMemoryFraction",
            "UseJittering",
            "ComputeNormalFromOpacity",
            "GlobalIlluminationReach",
            "VolumetricScatteringBlending",
            "Transfer2DYAxisArray",
            "ScalarMode",
            "ArrayAccessMode",
        ),
    )
    if smart.GetArrayAccessMode() == 0:
        gpu.SelectScalarArray(smart.GetArrayId())
    elif smart.GetArrayName():
        gpu.SelectScalarArray(smart.GetArrayName())
    gpu.SetScalarMode(smart.GetScalarMode())
    # As in the smart mapper's inner mapper.
    gpu.SetLockSampleDistanceToInputSpacing(1)
    gpu.SetAutoAdjustSampleDistances(0)
    return gpu
