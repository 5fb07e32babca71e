# SPDX-License-Identifier: MIT OR Apache-2.0
"""A 3D view of trame-slicer, moved by the events of a mouse."""

import numpy as np
import pytest

pytest.importorskip("trame_slicer", reason="trame-slicer is not installed (requirements-trame-slicer.txt)")

# Modules of the mappers and windows that VTK's object factories make.
import vtkmodules.vtkRenderingOpenGL2
import vtkmodules.vtkRenderingVolumeOpenGL2  # noqa: F401
from trame_slicer.core import SlicerApp
from trame_slicer.views import DirectViewFactory, ViewLayoutDefinition, ViewProps, ViewType
from vtkmodules.util.numpy_support import numpy_to_vtk
from vtkmodules.vtkCommonDataModel import vtkImageData

import entire.slicer
from scenes import pixels


# One application per process: Slicer crashes at the exit of a process that has made two applications.
@pytest.fixture(scope="module")
def view(voxels):
    app = SlicerApp()
    app.view_manager.register_factory(DirectViewFactory(True))
    view = app.view_manager.create_view(ViewLayoutDefinition("3d", ViewType.THREE_D_VIEW, ViewProps()))
    image = vtkImageData()
    image.SetDimensions(*voxels.shape[::-1])
    image.GetPointData().SetScalars(numpy_to_vtk(np.ascontiguousarray(voxels).ravel(), deep=1))
    node = app.scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "volume")
    node.SetAndObserveImageData(image)
    node.CreateDefaultDisplayNodes()
    app.volume_rendering.create_display_node(node, "CT-AAA")
    view.update_size(200, 200)
    view.reset_view()
    # Keeps the application alive, since the view has no reference to it.
    view.app = app
    yield view
    view.finalize()


def drag(view, steering, moves, first=100):
    """Moves the mouse with its left button down, one or more frames for each place. Returns reason and step."""
    interactor = view.interactor()

    def event(name, x):
        interactor.SetEventInformation(x, 100, 0, 0)
        interactor.InvokeEvent(name)

    event("EnterEvent", first)
    event("MouseMoveEvent", first)
    event("LeftButtonPressEvent", first)
    for x in range(first + 1, first + 1 + moves):
        event("MouseMoveEvent", x)
    last = steering.reason, steering.sample_distance
    event("LeftButtonReleaseEvent", first + moves)
    return last


def test_frames_under_the_mouse_are_held_and_still_ones_are_left(view):
    view.render()
    steering = entire.slicer.hold(view)
    assert steering.seconds == pytest.approx(1 / view.get_view_node().GetExpectedFPS())
    view.render()
    assert steering.steered_frames == 0
    plain = pixels(view.render_window())
    assert plain.std() > 5
    view.get_view_node().SetExpectedFPS(1000)
    reason, distance = drag(view, steering, 6)
    assert steering.steered_frames >= 6
    assert reason == "target unreachable"
    assert distance > 4
    # The mouse button is up: VTK draws the frame without steering.
    steered = steering.steered_frames
    view.render()
    assert steering.steered_frames == steered
    held = pixels(view.render_window())
    steering.detach()
    view.render()
    assert np.array_equal(pixels(view.render_window()), held)


def test_a_time_that_can_be_met_leaves_the_finest_step(view):
    steering = entire.slicer.hold(view, seconds=20)
    _, distance = drag(view, steering, 3)
    assert steering.steered_frames >= 3
    assert distance < 1
    steering.detach()
