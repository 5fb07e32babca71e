# SPDX-License-Identifier: MIT OR Apache-2.0
"""Several render passes in one frame of a window: stereo, renderers side by side."""

import sys
from pathlib import Path

import pytest

pytest.importorskip("vtkmodules")
# Shared with the tests of the C++ class vtkEntireSteering.
sys.path.insert(0, str(Path(__file__).parents[2] / "windows"))

import entire
import entire.vtk
import windows
from vtkmodules.vtkRenderingCore import vtkRenderer

from scenes import View, add_volume


@pytest.mark.parametrize(("mapper", "kind"), windows.CASES, ids=str)
def test_passes_share_the_time_of_a_frame(mapper, kind):
    windows.check("python", mapper, kind)


@pytest.mark.parametrize("mapper", windows.MAPPERS)
def test_what_shares_the_time_and_what_does_not(mapper):
    windows.check_others("python", mapper)


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
    # With a target that cannot be met, the held viewport is as coarse as allowed, and still shows the volume.
    held = entire.vtk.hold(other, seconds=1e-5, clock="cpu")
    view.draw(8)
    assert held.sample_distance > 2
    assert view.pixels()[:, 100:].mean() == pytest.approx(full, rel=0.3)
    assert (held.image_sample_distance == 1) == (kind == "gpu")
