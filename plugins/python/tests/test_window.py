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
    # Each eye gets half of the time for both.
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
    # A target that cannot be met: both are as coarse as allowed.
    held = entire.vtk.hold(other, seconds=1e-5, clock="cpu")
    view.draw(8)
    assert held.sample_distance > 2
    assert view.pixels()[:, 100:].mean() == pytest.approx(full, rel=0.3)
    assert (held.image_sample_distance == 1) == (kind == "gpu")
