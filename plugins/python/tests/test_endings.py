# SPDX-License-Identifier: MIT OR Apache-2.0
"""Settings after steering ends during a frame, volumes that share a mapper, values of the last frame, pictures of a
calibration, memory of deleted volumes and renderers, history and learned state after the end."""

import gc
import math
import weakref

import numpy as np
import pytest

pytest.importorskip("vtkmodules")

import entire
import entire.vtk
from vtkmodules.vtkRenderingCore import vtkRenderer, vtkVolume

from scenes import MAPPERS, View, add_volume, image_data, one_volume, settings


@pytest.mark.parametrize("kind", ["gpu", "fixed", "smart"])
@pytest.mark.parametrize("event", ["VolumeMapperRenderStartEvent", "VolumeMapperRenderEndEvent"])
@pytest.mark.parametrize("what", ["reset", "detach"])
def test_settings_are_restored_whenever_steering_ends(voxels, kind, event, what):
    view, volume = one_volume(voxels, kind)
    view.draw(1)
    own, before = volume.GetMapper(), settings(volume.GetMapper())
    steering = entire.vtk.hold(view.renderer, volume, seconds=1e-5, clock="cpu")
    view.draw(4)
    drawing = volume.GetMapper()
    tag = drawing.AddObserver(event, lambda *_: getattr(steering, what)())
    view.draw(1)
    drawing.RemoveObserver(tag)
    view.draw(1)
    steering.detach()
    assert volume.GetMapper() is own
    assert settings(own) == before


@pytest.mark.parametrize("kind", ["gpu", "fixed"])
def test_volumes_with_one_mapper_are_refused(voxels, kind):
    view, volume = one_volume(voxels, kind)
    mapper, second = volume.GetMapper(), vtkVolume()
    before = settings(mapper)
    second.SetMapper(mapper)
    view.renderer.AddVolume(second)
    for volumes in (None, [volume, second]):
        with pytest.raises(entire.CannotSteer, match="mapper of its own"):
            entire.vtk.hold(view.renderer, volumes, 1e-4)
    first = entire.vtk.hold(view.renderer, volume, 1e-4)
    with pytest.raises(entire.CannotSteer, match="mapper of its own"):
        entire.vtk.hold(view.renderer, [volume, second], 1e-4)
    # A refused volume does not end the steering of another one.
    assert [leaf.volume for leaf in first.leaves] == [volume]
    view.renderer.RemoveVolume(second)
    # A held volume that gets the mapper of another one is not steered until it has a mapper of its own.
    third = add_volume(view.renderer, voxels[:30], kind)
    other = entire.vtk.hold(view.renderer, third, 1e-4)
    third.SetMapper(mapper)
    view.draw(3)
    assert first.status == ""
    assert "mapper of its own" in other.status
    assert settings(mapper) == before
    own = MAPPERS[kind]()
    own.SetInputData(image_data(voxels))
    third.SetMapper(own)
    view.draw(2)
    assert first.status == other.status == ""


def test_volumes_with_one_smart_mapper_are_steered(voxels):
    view, volume = one_volume(voxels, "smart")
    smart, second = volume.GetMapper(), vtkVolume()
    second.SetMapper(smart)
    second.SetProperty(volume.GetProperty())
    second.SetPosition(10, 0, 0)
    view.renderer.AddVolume(second)
    steering = entire.vtk.hold(view.renderer, seconds=1e-4)
    view.draw(3)
    assert steering.steered_frames == 6
    steering.detach()
    assert volume.GetMapper() is second.GetMapper() is smart


def test_read_outs_are_of_the_last_frame(voxels):
    view = View()
    left, right = add_volume(view.renderer, voxels), add_volume(view.renderer, voxels[:24])
    right.VisibilityOff()
    steering = entire.vtk.hold(view.renderer, seconds=1.0, clock="cpu")
    view.draw(3)
    assert 0 < steering.measured <= steering.frame_time
    assert steering.predicted > 0
    right.VisibilityOn()
    view.draw(3)
    both = math.fsum(leaf.measured for leaf in steering.leaves)
    assert steering.measured == pytest.approx(both)
    left.VisibilityOff()
    view.draw(1)
    assert steering.measured == next(leaf for leaf in steering.leaves if leaf.volume is right).measured


def test_calibration_hides_the_overlay_from_its_pictures(voxels):
    view, volume = one_volume(voxels)
    entire.vtk.hold(view.renderer, volume, seconds=1.0, clock="cpu", overlay=True)
    seen = []

    def error(picture, full):
        seen.append(np.abs(picture.astype(int) - full).max())
        return float(seen[-1])

    entire.vtk.calibrate(view.renderer, frames=10, pictures=3, clock="cpu", picture_error=error)
    # With the overlay, pixels of its text would differ by 255.
    assert max(seen) < 200


def test_a_volume_changes_hands(voxels):
    view, volume = one_volume(voxels, "smart")
    smart = volume.GetMapper()
    first = entire.vtk.hold(view.renderer, volume, 0.1)
    second = entire.vtk.hold(view.renderer, volume, 0.001)
    assert first.leaves == []
    view.draw(2)
    assert second.steered_frames == 2
    second.detach()
    assert volume.GetMapper() is smart
    assert "nothing" in repr(first)


def test_a_renderer_has_one_steering_of_all_its_volumes(voxels):
    view, volume = one_volume(voxels)
    first = entire.vtk.hold(view.renderer, seconds=0.1)
    view.renderer.RemoveVolume(volume)
    view.draw(1)
    add_volume(view.renderer, voxels)
    second = entire.vtk.hold(view.renderer, seconds=0.001)
    # The first steering has no volume when the second one begins, and must not take a volume that is added later.
    add_volume(view.renderer, voxels[:30])
    view.draw(2)
    assert first.leaves == []
    assert len(second.leaves) == 2


@pytest.mark.parametrize("how", ["detach", "remove"])
def test_history_and_learned_state_of_the_last_volume_stay(voxels, tmp_path, how):
    view, volume = one_volume(voxels)
    steering, file = entire.vtk.hold(view.renderer, seconds=0.01), tmp_path / "state"
    view.draw(4)
    session = steering.leaves[0].session
    frames, state = len(session.history), session.save_state()
    assert frames > 0
    if how == "detach":
        steering.detach()
    else:
        view.renderer.RemoveVolume(volume)
        view.draw(1)
    assert steering.leaves == []
    assert len(steering.history) == frames
    steering.save(file)
    assert file.read_bytes() == state
    steering.reset()
    assert len(steering.history) == 0
    with pytest.raises(ValueError, match="nothing was learned"):
        steering.save(file)


@pytest.mark.parametrize("given", [False, True])
def test_a_deleted_volume_leaves_no_voxels(voxels, given):
    view, volume = one_volume(voxels)
    steering = entire.vtk.hold(view.renderer, volume if given else None, 0.01)
    view.draw(2)
    deleted = []
    scalars = volume.GetMapper().GetInput().GetPointData().GetScalars()
    scalars.AddObserver("DeleteEvent", lambda *_: deleted.append(1))
    view.renderer.RemoveVolume(volume)
    del volume, scalars
    view.draw(1)
    gc.collect()
    assert steering.leaves == []
    assert deleted


def test_a_window_does_not_keep_the_steerings_of_deleted_renderers(voxels):
    view, gone = View(), []
    for _ in range(3):
        renderer = vtkRenderer()
        view.window.AddRenderer(renderer)
        add_volume(renderer, voxels)
        gone.append(weakref.ref(entire.vtk.hold(renderer, seconds=0.01)))
        view.window.Render()
        view.window.RemoveRenderer(renderer)
        del renderer
        gc.collect()
    view.window.Render()
    gc.collect()
    assert all(steering() is None for steering in gone)
