# SPDX-License-Identifier: MIT OR Apache-2.0
"""Reads a volume from a VTK scene: voxels, transfer function, camera."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from operator import methodcaller
from typing import Any, NamedTuple

import numpy as np
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkDataArray
from vtkmodules.vtkCommonMath import vtkMatrix4x4

from .._native import Camera, TransferFunction, Volume

_SUBVOLUME = 0x0002000
_COMPOSITE = 0
# Number of entries of a transfer function's table.
_SAMPLES = 256

#: Accumulated opacity at which the mappers stop a ray.
GPU_TERMINATION = 0.996
FIXED_POINT_TERMINATION = 0.99


def _copied(matrix: Any) -> tuple[float, ...]:
    out = [0.0] * (16 if matrix.IsA("vtkMatrix4x4") else 9)
    matrix.DeepCopy(out, matrix)
    return tuple(out)


#: Returns a matrix's elements, row by row. In VTK before 9.4, GetData() gives Python only an address.
elements: Callable[[Any], tuple[float, ...]] = (
    methodcaller("GetData") if isinstance(vtkMatrix4x4().GetData(), tuple) else _copied
)


Look = tuple[int, int, int, bool, bool, bool]


class Unreadable(ValueError):
    """The scene cannot be predicted; the text gives the reason."""


def input_of(mapper: Any) -> Any:
    """The image that a mapper draws.

    Raises
    ------
    Unreadable
        If the mapper has no input, or an input that is not vtkImageData.
    """
    data = mapper.GetDataObjectInput() if hasattr(mapper, "GetDataObjectInput") else mapper.GetInput()
    if data is None:
        raise Unreadable("the mapper has no input yet")
    if not data.IsA("vtkImageData"):
        raise Unreadable(f"the mapper's input is {data.GetClassName()}; only vtkImageData is supported")
    return data


class Grid:
    """The voxels that a mapper draws, and their position."""

    __slots__ = ("center", "direction", "range", "reference", "volume")

    def __init__(self, mapper: Any, image: Any, component: int) -> None:
        scalars, on_cells = _scalars(mapper, image)
        dims = tuple(n - on_cells for n in image.GetDimensions())
        if min(dims) < 1:
            raise Unreadable("the mapper's input is empty")
        components = scalars.GetNumberOfComponents()
        component = component if component >= 0 else components - 1
        if scalars.GetNumberOfTuples() != dims[0] * dims[1] * dims[2]:
            raise Unreadable(
                f"the mapper's input has {scalars.GetNumberOfTuples()} scalar values for {dims} voxels"
            )
        if not scalars.HasStandardMemoryLayout():
            # vtk_to_numpy() would make VTK copy the whole array and keep the copy as long as the array lives.
            scalars, component, components = _copy_of(scalars, component), 0, 1
        try:
            values = vtk_to_numpy(scalars)
        except (AssertionError, ValueError, TypeError) as error:
            raise Unreadable(
                f"scalars of type {scalars.GetDataTypeAsString()} are not supported: {error}"
            ) from None
        voxels = values.reshape(dims[2], dims[1], dims[0], components)[..., component]
        spacing = [abs(s) for s in image.GetSpacing()]
        if not all(math.isfinite(s) and s > 0 for s in spacing):
            raise Unreadable(f"the mapper's input has a spacing of {spacing}; all three must be finite and not 0")
        low, high = [0, 0, 0], list(dims)
        if mapper.GetCropping() and mapper.GetCroppingRegionFlags() == _SUBVOLUME:
            low, high = _cropped(mapper, image, dims, spacing)
        span = scalars.GetFiniteRange(component)
        self.range = (float(span[0]), float(span[1]))
        if not self.range[0] <= self.range[1]:
            raise Unreadable("the scalars have no finite value")
        with np.errstate(over="ignore"):
            flat = not np.float32(self.range[1]) > np.float32(self.range[0])
        if flat:
            self.range = (self.range[0], self.range[0] + max(1.0, abs(self.range[0])))
        box = voxels[low[2] : high[2], low[1] : high[1], low[0] : high[0]]
        self.volume = Volume(box, (spacing[0], spacing[1], spacing[2]), range=self.range)
        self.reference = min(spacing)
        extent = image.GetExtent()
        at = [0.5 * (low[a] + high[a] - 1) + 0.5 * on_cells + extent[2 * a] for a in range(3)]
        center = [0.0, 0.0, 0.0]
        image.TransformContinuousIndexToPhysicalPoint(at, center)
        self.center = (center[0], center[1], center[2])
        self.direction = elements(image.GetDirectionMatrix())


def _copy_of(scalars: Any, component: int) -> Any:
    """A copy of one component of an array, with the standard memory layout."""
    copied = vtkDataArray.CreateDataArray(scalars.GetDataType())
    copied.SetNumberOfTuples(scalars.GetNumberOfTuples())
    copied.CopyComponent(0, scalars, component)
    return copied


def _scalars(mapper: Any, image: Any) -> tuple[Any, int]:
    """The drawn array, and 1 if it belongs to cells, 0 if to points."""
    point, cell = image.GetPointData(), image.GetCellData()
    mode = mapper.GetScalarMode()
    by_name = mapper.GetArrayAccessMode() != 0
    which = mapper.GetArrayName() if by_name else mapper.GetArrayId()
    if mode == 3:  # point field data
        found, on_cells = point.GetArray(which), 0
    elif mode == 4:  # cell field data
        found, on_cells = cell.GetArray(which), 1
    elif mode == 2:
        found, on_cells = cell.GetScalars(), 1
    elif mode == 1 or point.GetScalars() is not None:
        found, on_cells = point.GetScalars(), 0
    else:
        found, on_cells = cell.GetScalars(), 1
    if found is None:
        raise Unreadable("the mapper's input has no scalars to draw")
    return found, on_cells


def _cropped(
    mapper: Any, image: Any, dims: tuple[int, ...], spacing: list[float]
) -> tuple[list[int], list[int]]:
    """Along each axis, the first voxel inside the cropping box and the one after the last."""
    planes, origin, extent = mapper.GetCroppingRegionPlanes(), image.GetOrigin(), image.GetExtent()
    low, high = [0, 0, 0], [0, 0, 0]
    for axis in range(3):
        last = dims[axis] - 1
        a = (planes[2 * axis] - origin[axis]) / spacing[axis] - extent[2 * axis]
        b = (planes[2 * axis + 1] - origin[axis]) / spacing[axis] - extent[2 * axis]
        if not (a <= b and b >= 0 and a <= last):
            raise Unreadable("the cropping box leaves nothing to draw")
        low[axis] = max(0, math.floor(a))
        high[axis] = min(last, math.ceil(b)) + 1
    return low, high


def grid_key(mapper: Any, image: Any, component: int) -> tuple[Any, ...]:
    """Values that change whenever a :class:`Grid` must be read again. They include the image's identity, since images
    that share an array may have the same MTime."""
    cropping = mapper.GetCropping()
    return (
        image.__this__,
        image.GetMTime(),
        component,
        mapper.GetScalarMode(),
        mapper.GetArrayId(),
        mapper.GetArrayName(),
        cropping and (mapper.GetCroppingRegionFlags(), mapper.GetCroppingRegionPlanes()),
    )


def _unit(value: float) -> float:
    return 0.0 if math.isnan(value) else min(1.0, max(0.0, value))


def transfer_key(prop: Any) -> tuple[Any, ...]:
    """Values that change whenever :func:`transfer_nodes` may have changed, but not when other settings, such as
    lighting, change."""
    channels = prop.GetColorChannels(0)
    functions = [prop.GetScalarOpacity(0)]
    if channels == 3:
        functions.append(prop.GetRGBTransferFunction(0))
    times = [(function.__this__, function.GetMTime()) for function in functions]
    return (channels, prop.GetScalarOpacityUnitDistance(0), *times)


class Nodes(NamedTuple):
    """Inputs of :meth:`TransferFunction.nodes`."""

    opacity: list[tuple[float, float, float, float]]
    #: Empty if the volume is gray.
    color: list[tuple[float, float, float, float, float, float]]
    #: Minimum and maximum scalar value.
    span: tuple[float, float]
    clamp: bool
    #: ScalarOpacityUnitDistance.
    unit: float


def transfer_nodes(prop: Any, span: tuple[float, float]) -> Nodes:
    """Reads a volume property's opacity and color functions of the first component."""
    node = [0.0] * 4
    opacity = []
    function = prop.GetScalarOpacity(0)
    if function.GetUseLogScale():
        # Nodes are interpolated by their values, not by logarithms of them, so samples replace the nodes.
        for x in np.linspace(*span, _SAMPLES):
            opacity.append((float(x), _unit(function.GetValue(x)), 0.5, 0.0))
    else:
        for i in range(function.GetSize()):
            function.GetNodeValue(i, node)
            opacity.append((node[0], _unit(node[1]), _unit(node[2]), _unit(node[3])))
    color = []
    if prop.GetColorChannels(0) == 3:
        colors = prop.GetRGBTransferFunction(0)
        node = [0.0] * 6
        for i in range(colors.GetSize()):
            colors.GetNodeValue(i, node)
            color.append(
                (node[0], _unit(node[1]), _unit(node[2]), _unit(node[3]), _unit(node[4]), _unit(node[5]))
            )
    return Nodes(
        opacity, color, span, bool(function.GetClamping()), float(prop.GetScalarOpacityUnitDistance(0))
    )


def transfer_function(nodes: Nodes) -> TransferFunction:
    return TransferFunction.nodes(
        nodes.opacity, nodes.color, range=nodes.span, clamp=nodes.clamp, unit_length=nodes.unit
    )


def vertical_angle(active: Any, size: tuple[int, int]) -> float:
    """Vertical field of view in degrees of a camera, in an image of this size."""
    angle: float = active.GetViewAngle()
    if not active.GetUseHorizontalViewAngle():
        return angle
    width, height = size
    return 2 * math.degrees(math.atan(math.tan(math.radians(0.5 * angle)) * height / max(1, width)))


def drawn_matrix(renderer: Any, volume: Any) -> Any:
    """The matrix with which the renderer will draw a volume: in an assembly, a product with the assembly's matrices.

    While the assembly draws, the volume's own matrix is this product; do not call this function then, since the
    assembly may delete the paths that it iterates over, and build them again.
    """
    if not renderer.HasViewProp(volume):
        props = renderer.GetViewProps()
        for i in range(props.GetNumberOfItems()):
            prop = props.GetItemAsObject(i)
            prop.InitPathTraversal()
            for path in iter(prop.GetNextPath, None):
                node = path.GetLastNode()
                if node.GetViewProp() is volume and node.GetMatrix() is not None:
                    return node.GetMatrix()
    return volume.GetMatrix()


def camera(renderer: Any, placed: Sequence[float], grid: Grid) -> Camera:
    """The renderer's camera relative to a volume; `placed` is the volume's matrix, 16 elements, row by row."""
    active = renderer.GetActiveCamera()
    return Camera.scene(
        grid.volume,
        elements(active.GetViewTransformMatrix()),
        placed,
        grid.direction,
        grid.center,
        vertical_angle(active, renderer.GetSize()),
        active.GetParallelScale() if active.GetParallelProjection() else None,
    )


def look(prop: Any, mapper: Any) -> Look:
    """Settings whose change is announced as a change of mode: shading, interpolation, blend mode, gradient opacity; of
    GPU mappers also jittering and scattering."""
    gradient = bool(prop.HasGradientOpacity(0)) and not prop.GetDisableGradientOpacity(0)
    jitters = hasattr(mapper, "GetUseJittering") and bool(mapper.GetUseJittering())
    scatters = hasattr(mapper, "GetVolumetricScatteringBlending") and mapper.GetVolumetricScatteringBlending() > 0
    return (prop.GetShade(0), prop.GetInterpolationType(), mapper.GetBlendMode(), gradient, jitters, scatters)


def termination(mode: Look, gpu: bool) -> float:
    if mode[2] != _COMPOSITE:
        return 1.0
    return GPU_TERMINATION if gpu else FIXED_POINT_TERMINATION
