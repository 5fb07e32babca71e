# SPDX-License-Identifier: MIT OR Apache-2.0
"""Render modes and memory layouts of scalars, which some VTK versions lack, and volumes in assemblies."""

import numpy as np
import pytest

pytest.importorskip("vtkmodules")

import entire
import entire.vtk
from vtkmodules import vtkCommonCore
from vtkmodules.vtkRenderingCore import vtkAssembly
from vtkmodules.vtkRenderingVolumeOpenGL2 import vtkSmartVolumeMapper

from scenes import add_volume, image_data, one_volume

VERSION = vtkCommonCore.vtkVersion().GetVTKVersion()


@pytest.mark.parametrize("name", ["OSPRay", "ANARI"])
def test_render_modes_outside_of_vtk_are_refused_by_name(voxels, name):
    mode = {"OSPRay": "OSPRayRenderMode", "ANARI": "AnariRenderMode"}[name]
    if not hasattr(vtkSmartVolumeMapper, mode):
        pytest.skip(f"VTK {VERSION} has no render mode by {name}")
    view, volume = one_volume(voxels, "smart")
    smart = volume.GetMapper()
    smart.SetRequestedRenderMode(getattr(vtkSmartVolumeMapper, mode))
    with pytest.raises(entire.CannotSteer, match=f"told to draw by {name}"):
        entire.vtk.hold(view.renderer, volume, 0.1)
    assert volume.GetMapper() is smart
    smart.SetRequestedRenderModeToDefault()
    entire.vtk.hold(view.renderer, volume, 0.1).detach()
    # A volume with this mode that is added later is not steered, and a note says so.
    steering = entire.vtk.hold(view.renderer, seconds=0.1)
    later = add_volume(view.renderer, voxels, "smart")
    later.GetMapper().SetRequestedRenderMode(getattr(vtkSmartVolumeMapper, mode))
    later.VisibilityOff()
    view.draw(2)
    assert [leaf.volume for leaf in steering.leaves] == [volume]
    assert any(name in note for note in steering.notes)


def test_low_resolution_mode_is_refused(voxels):
    if not hasattr(vtkSmartVolumeMapper, "SetLowResMode"):
        pytest.skip(f"VTK {VERSION} has no low-resolution mode in vtkSmartVolumeMapper")
    view, volume = one_volume(voxels, "smart")
    volume.GetMapper().SetLowResMode(vtkSmartVolumeMapper.LowResModeResample)
    with pytest.raises(entire.CannotSteer, match="LowResMode"):
        entire.vtk.hold(view.renderer, volume, 0.1)
    volume.GetMapper().SetLowResMode(vtkSmartVolumeMapper.LowResModeDisabled)
    entire.vtk.hold(view.renderer, volume, 0.1)


@pytest.mark.parametrize("components", [1, 2])
def test_scalars_of_any_layout_are_read_without_a_copy_of_all(voxels, components):
    template = getattr(vtkCommonCore, "vtkSOADataArrayTemplate", None)
    if template is None:
        pytest.skip(f"VTK {VERSION} has no structure of arrays in Python")
    steps = []
    for apart in (False, True):
        view, volume = one_volume(voxels)
        data = volume.GetMapper().GetInput().GetPointData()
        values = vtkCommonCore.vtkUnsignedCharArray()
        values.SetNumberOfComponents(components)
        values.SetNumberOfTuples(voxels.size)
        for component in range(components):
            values.CopyComponent(component, data.GetScalars(), 0)
        warned = []
        if apart:
            together, values = values, template["uint8"]()
            values.DeepCopy(together)
            assert not values.HasStandardMemoryLayout()
            values.AddObserver("WarningEvent", lambda *_: warned.append(1))
        data.SetScalars(values)
        volume.GetProperty().SetIndependentComponents(components == 1)
        steering = entire.vtk.hold(view.renderer, volume, 1e-4, model="unshaded-selected", clock="cpu")
        leaf = steering.leaves[0]
        grid = entire.vtk._scene.Grid(volume.GetMapper(), volume.GetMapper().GetInput(), components - 1)
        assert not warned
        assert grid.volume.shape == voxels.shape[::-1]
        view.draw(1)
        assert leaf.status == ""
        steps.append(leaf.predicted)
    assert steps[0] > 0
    assert steps[0] == steps[1]


def test_an_input_that_cannot_be_used_is_read_once(voxels, monkeypatch):
    view, volume = one_volume(voxels)
    read, grid = [], entire.vtk._scene.Grid
    monkeypatch.setattr(entire.vtk._scene, "Grid", lambda *of: read.append(1) or grid(*of))
    large = voxels.astype(np.float64)
    # Infinite in single precision.
    large[0, 0, 0] = 1e300
    volume.GetMapper().SetInputData(image_data(large))
    steering = entire.vtk.hold(view.renderer, volume, 1e-4)
    view.draw(3)
    assert steering.reason == "fallback"
    assert len(read) == 1
    # The input is read again after a change, and after a reset.
    steering.reset()
    view.draw(2)
    assert steering.reason == "fallback"
    assert len(read) == 2
    volume.GetMapper().SetInputData(image_data(voxels))
    view.draw(2)
    assert steering.status == ""
    assert len(read) == 3


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_scalars_without_a_finite_value_are_not_predicted(voxels, value, dtype):
    view, volume = one_volume(voxels)
    volume.GetMapper().SetInputData(image_data(np.full((4, 5, 6), value, dtype)))
    steering = entire.vtk.hold(view.renderer, volume, 1e-4)
    view.draw(1)
    assert (steering.reason, steering.status) == ("fallback", "the scalars have no finite value")


def test_rays_that_begin_at_noise_are_steered(voxels):
    view, volume = one_volume(voxels)
    steering = entire.vtk.hold(view.renderer, volume, 1e-4)
    view.draw(3)
    leaf = steering.leaves[0]
    smooth = view.pixels()
    assert not any(leaf._look[4:])
    volume.GetMapper().UseJitteringOn()
    view.draw(3)
    assert leaf._look[4]
    assert steering.fallback_frames == 0
    assert not np.array_equal(view.pixels(), smooth)
    # A GPU mapper that replaces a smart mapper takes over its jittering.
    smart = vtkSmartVolumeMapper()
    if not hasattr(smart, "SetUseJittering"):
        pytest.skip(f"VTK {VERSION} has no jittering in vtkSmartVolumeMapper")
    smart.SetUseJittering(1)
    smart.SetInputData(volume.GetMapper().GetInput())
    volume.SetMapper(smart)
    entire.vtk.hold(view.renderer, volume, 1e-4)
    assert volume.GetMapper().GetUseJittering()


def put_in_assembly(view, volume):
    """Makes a volume of a view a part of an assembly; returns the assembly."""
    assembly = vtkAssembly()
    view.renderer.RemoveVolume(volume)
    assembly.AddPart(volume)
    view.renderer.AddViewProp(assembly)
    return assembly


@pytest.mark.parametrize("kind", ["gpu", "fixed"])
def test_a_volume_is_planned_where_its_assembly_places_it(voxels, kind):
    def predicted(assembled, scale):
        view, volume = one_volume(voxels, kind)
        moved = put_in_assembly(view, volume) if assembled else volume
        moved.SetScale(scale)
        moved.SetPosition(3, 2, 1)
        steering = entire.vtk.hold(view.renderer, volume, 1e-4, model="unshaded-selected", clock="cpu")
        view.draw(1)
        assert steering.status == ""
        return steering.predicted

    small = predicted(True, 0.5)
    assert small > 0
    assert small == predicted(False, 0.5)
    assert small != predicted(False, 1.0)


def test_a_volume_is_calibrated_where_its_assembly_places_it(voxels, monkeypatch):
    view, volume = one_volume(voxels, "fixed")
    assembly = put_in_assembly(view, volume)
    assembly.SetScale(0.5)
    assembly.SetPosition(1000, 0, 0)
    seen, aims, scene = [], [], entire.vtk._scene
    camera = scene.camera

    def noted(renderer, placed, grid):
        seen.append(placed)
        aims.append(renderer.GetActiveCamera().GetFocalPoint()[0])
        return camera(renderer, placed, grid)

    monkeypatch.setattr(scene, "camera", noted)
    entire.vtk.calibrate(view.renderer, volume, frames=10, pictures=0)
    assert set(seen) == {scene.elements(assembly.GetMatrix())}
    assert min(aims) > 900 and max(aims) < 1100


def test_still_frames_that_vtk_may_coarsen_are_not_observed(voxels):
    view, volume = one_volume(voxels, "fixed")
    steering = entire.vtk.hold(view.renderer, volume, 0.1)

    def observed(adjust, rate):
        volume.GetMapper().SetAutoAdjustSampleDistances(adjust)
        before = len(steering.history)
        with steering.still():
            view.window.SetDesiredUpdateRate(rate)
            view.window.Render()
        assert steering.reason == "still"
        return len(steering.history) - before

    assert observed(0, 0.5) == 1
    assert observed(1, 0.5) == 0
    assert observed(1, 0.0001) == 1
