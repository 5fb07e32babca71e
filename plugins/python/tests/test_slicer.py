# SPDX-License-Identifier: MIT OR Apache-2.0
"""3D Slicer's views, with slicer-core."""

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("vtkmodules")
pytest.importorskip("slicer", reason="slicer-core is not installed (requirements-slicer.txt)")

import entire.slicer
from scenes import COLOR, OPAQUE, TRANSPARENT
from slicer_view import SlicerView, preset


@pytest.fixture
def view(voxels):
    view = SlicerView()
    view.display = view.show(voxels)
    preset(view.display, OPAQUE, COLOR)
    view.node.SetVolumeRenderingQuality(view.node.Adaptive)
    return view


def test_moved_frames_are_held_to_the_expected_rate(view):
    view.node.SetExpectedFPS(1000)
    steering = entire.slicer.hold(view.manager)
    assert steering.seconds == pytest.approx(1 / 1000)
    view.move()
    view.draw(4)
    assert steering.steered_frames >= 3
    assert steering.fallback_frames == 0
    assert steering.reason == "target unreachable"
    assert steering.sample_distance > 4
    view.node.SetExpectedFPS(0.05)
    assert steering.seconds == pytest.approx(20)
    view.move()
    view.draw(2)
    assert steering.reason == "finest allowed"
    # A frame time given to hold() is kept when the view's rate changes.
    other = entire.slicer.hold(view.group, seconds=0.5)
    view.node.SetExpectedFPS(20)
    assert other.seconds == 0.5
    assert not steering.leaves


@pytest.mark.parametrize("rate", [2, 30])
def test_still_frames_are_slicers_byte_for_byte(view, rate):
    view.node.SetExpectedFPS(rate)
    view.rest()
    view.draw(2)
    view.orbit(40, 110)
    view.window.Render()
    plain = view.pixels()
    assert plain.std() > 5
    steering = entire.slicer.hold(view.manager, seconds=1e-4)
    view.move()
    # Slicer requests less than one frame per second from VTK if it expects two.
    assert (view.window.GetDesiredUpdateRate() < 1) == (rate == 2)
    view.draw(3)
    assert steering.reason not in ("still", "fallback")
    assert not np.array_equal(view.pixels(), plain)
    view.rest()
    view.orbit(40, 110)
    view.window.Render()
    assert steering.reason == "still"
    assert np.array_equal(view.pixels(), plain)
    steering.detach()
    view.window.Render()
    assert np.array_equal(view.pixels(), plain)


def test_full_quality_is_left_alone(view):
    steering = entire.slicer.hold(view.manager, seconds=1e-4)
    view.move()
    view.node.SetVolumeRenderingQuality(view.node.Maximum)
    view.window.SetDesiredUpdateRate(15)
    view.draw(2)
    assert steering.reason == "off"
    view.node.SetVolumeRenderingQuality(view.node.Normal)
    view.move()
    view.draw(2)
    assert steering.reason == "target unreachable"


def test_display_nodes_are_followed(view, voxels):
    steering = entire.slicer.hold(view.manager, seconds=1e-4)
    view.move()
    view.draw(2)
    assert len(steering.leaves) == 1
    # Changes a preset, shows a second volume, hides it, and shows a third one with another rendering method.
    nodes = steering.leaves[0]._nodes
    preset(view.display, TRANSPARENT, COLOR)
    view.draw(1)
    assert steering.leaves[0]._nodes != nodes
    second = view.show(voxels[:, :30])
    view.draw(2)
    assert len(steering.leaves) == 2
    assert all(leaf.reason == "target unreachable" for leaf in steering.leaves)
    second.SetVisibility(0)
    steered = steering.steered_frames
    view.draw(1)
    assert steering.steered_frames == steered + 1
    third = view.show(voxels[:24], method="CPU")
    view.draw(2)
    assert any("vtkFixedPoint" in leaf._class for leaf in steering.leaves)
    for display in (second, third):
        view.scene.RemoveNode(display)
    view.draw(2)
    assert len(steering.leaves) == 1
    assert steering.fallback_frames == 0


def test_a_view_may_be_empty_at_first(voxels):
    view = SlicerView()
    steering = entire.slicer.hold(view.group)
    view.draw(1)
    assert not steering.leaves
    view.show(voxels)
    view.move()
    view.draw(2)
    assert len(steering.leaves) == 1


def test_a_second_call_on_an_empty_view_replaces_the_first(voxels):
    view = SlicerView()
    first = entire.slicer.hold(view.group, seconds=20)
    second = entire.slicer.hold(view.group, seconds=1e-4)
    view.show(voxels)
    view.move()
    view.draw(2)
    assert not first.leaves
    assert len(second.leaves) == 1


def test_views_of_slicer_lead_to_their_manager(view):
    # The methods by which qMRMLThreeDWidget and qMRMLThreeDView return the manager.
    three_d_view = SimpleNamespace(displayableManagerByClassName=view.group.GetDisplayableManagerByClassName)
    widget = SimpleNamespace(threeDView=lambda: three_d_view)
    for each in (widget, three_d_view, view.group, view.manager):
        steering = entire.slicer.hold(each)
        assert len(steering.leaves) == 1
        before = steering.seconds
        steering.detach()
        view.node.SetExpectedFPS(view.node.GetExpectedFPS() + 1)
        assert steering.seconds == before


def test_seconds_must_be_positive(view):
    with pytest.raises(ValueError, match="seconds is 0"):
        entire.slicer.hold(view.manager, seconds=0)


def test_what_is_no_view_says_so():
    with pytest.raises(ValueError, match="without a vtkMRMLVolumeRenderingDisplayableManager"):
        entire.slicer.hold(object())
