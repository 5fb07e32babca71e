# SPDX-License-Identifier: MIT OR Apache-2.0
"""Several passes in a window's frame: two eyes, renderers side by side."""

import pytest

pytest.importorskip("vtkmodules")

import entire
import entire.vtk
from vtkmodules.vtkRenderingCore import vtkRenderer

from scenes import View, add_volume


@pytest.mark.parametrize("kind", ["gpu", "fixed"])
def test_a_stereo_frame_has_one_budget_for_both_eyes(voxels, kind):
    view = View()
    add_volume(view.renderer, voxels, kind)
    view.window.StereoCapableWindowOn()
    view.window.SetStereoTypeToAnaglyph()
    view.window.SetStereoRender(1)
    held = entire.vtk.hold(view.renderer, seconds=10.0, clock="cpu")
    view.draw(6)
    full = held.frame_time
    held.seconds = 0.5 * full
    view.draw(14)
    leaf = held.leaves[0]
    assert leaf._passes == 2
    # Each eye has half of what is left to both.
    assert held._share(leaf) == pytest.approx(0.5 * held._left)
    assert held.steered_frames == 2 * held.frames


@pytest.mark.parametrize("kind", ["gpu", "fixed"])
def test_no_viewport_is_empty_however_coarse(voxels, kind):
    view = View((200, 100))
    other = vtkRenderer()
    view.window.AddRenderer(other)
    view.renderer.SetViewport(0, 0, 0.5, 1)
    other.SetViewport(0.5, 0, 1, 1)
    add_volume(view.renderer, voxels, kind)
    add_volume(other, voxels, kind)
    other.SetActiveCamera(view.renderer.GetActiveCamera())
    view.draw(1)
    full = view.pixels()[:, 100:].mean()
    assert full > 1
    # A target that nothing meets: both are as coarse as they may be.
    held = entire.vtk.hold(other, seconds=1e-5, clock="cpu")
    view.draw(8)
    assert held.sample_distance > 2
    assert view.pixels()[:, 100:].mean() == pytest.approx(full, rel=0.3)
    assert (held.image_sample_distance == 1) == (kind == "gpu")


def test_renderers_of_one_window_share_its_frame(voxels):
    view = View((200, 100))
    other = vtkRenderer()
    view.window.AddRenderer(other)
    view.renderer.SetViewport(0, 0, 0.5, 1)
    other.SetViewport(0.5, 0, 1, 1)
    add_volume(view.renderer, voxels)
    add_volume(other, voxels)
    other.SetActiveCamera(view.renderer.GetActiveCamera())
    both = [entire.vtk.hold(renderer, seconds=1.0, clock="cpu") for renderer in (view.renderer, other)]
    view.draw(6)
    shares = [0.0, 0.0]
    for i, held in enumerate(both):
        # Who shares the window is known while it draws.
        held.on_frame = lambda held, i=i: shares.__setitem__(i, held._share(held.leaves[0]))
    view.draw(1)
    weights = [held.leaves[0]._weight for held in both]
    assert sum(shares) == pytest.approx(both[0]._left, rel=0.2)
    assert shares[0] / shares[1] == pytest.approx(weights[0] / weights[1], rel=0.2)
    # What the other one drew is not the rest of the frame.
    rest = 1.0 - both[0]._left
    assert rest < 0.5 * both[1].measured
    both[1].detach()
    view.draw(2)
    assert both[0]._alone
