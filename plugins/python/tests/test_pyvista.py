# SPDX-License-Identifier: MIT OR Apache-2.0
"""PyVista: three lines, widgets, several renderers, screenshots and movies."""

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

pv = pytest.importorskip("pyvista")

# Shared with the tests of the C++ class vtkEntireSteering.
sys.path.insert(0, str(Path(__file__).parents[2] / "windows"))

import entire
import entire.vtk
import windows

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


@pytest.fixture
def image(voxels):
    grid = pv.ImageData(dimensions=voxels.shape[::-1])
    grid["values"] = voxels.ravel()
    return grid


@pytest.fixture
def shown(image):
    plotter = pv.Plotter(window_size=(240, 240))
    actor = plotter.add_volume(image, scalars="values", show_scalar_bar=False)
    plotter.show(auto_close=False, interactive=False)
    yield plotter, actor
    plotter.close()


def drag(plotter, steps=6, at=(120, 120)):
    """Moves the camera as a mouse does."""
    interactor = plotter.render_window.GetInteractor()
    interactor.SetEventInformation(*at, 0, 0)
    interactor.InvokeEvent("LeftButtonPressEvent")
    for k in range(steps):
        interactor.SetEventInformation(at[0] + 6 * k, at[1] + 3 * k, 0, 0)
        interactor.InvokeEvent("MouseMoveEvent")
        yield k
    interactor.InvokeEvent("LeftButtonReleaseEvent")


def test_three_lines(image):
    pl = pv.Plotter(window_size=(240, 240))
    pl.add_volume(image)
    pl.entire.hold(fps=30)
    pl.show(auto_close=False, interactive=False)
    assert [s.reason for s in [pl.entire.steering]] == ["still"]
    for _ in drag(pl):
        assert pl.entire.steering.reason not in ("still", "fallback", "")
    assert len(pl.entire.history) > 4
    pl.close()


def test_history_and_learned_state_outlive_the_window(image, tmp_path):
    pl = pv.Plotter(window_size=(240, 240))
    pl.add_volume(image)
    steering = pl.entire.hold(fps=30)
    pl.show(auto_close=False, interactive=False)
    for _ in drag(pl):
        pass
    frames = len(pl.entire.history)
    assert frames > 4
    pl.close()
    assert steering.leaves == []
    assert pl.entire.steering is steering
    assert len(pl.entire.history) >= frames
    pl.entire.steering.save(tmp_path / "state")
    assert (tmp_path / "state").stat().st_size > 0


@pytest.mark.parametrize(("name", "volumes"), [("three_lines", 1), ("several_volumes", 3), ("clip_plane", 1)])
def test_examples_print_their_histories_after_the_window_was_closed(name, volumes, monkeypatch, capsys):
    show = pv.Plotter.show

    def show_and_drag(plotter):
        show(plotter, auto_close=False, interactive=False)
        for _ in drag(plotter, at=(90, 300)):
            pass
        plotter.close()

    monkeypatch.setattr(pv.Plotter, "show", show_and_drag)
    runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
    histories = [line for line in capsys.readouterr().out.splitlines() if line.startswith("History(")]
    assert len(histories) == volumes
    assert not any("no frames" in history for history in histories)


def test_the_mapper_is_exchanged_and_put_back(shown):
    plotter, actor = shown
    smart = actor.mapper
    look = plotter.screenshot()
    steering = plotter.entire.hold(fps=1000)
    assert any("vtkSmartVolumeMapper" in note for note in steering.notes)
    assert actor.mapper.IsA("vtkGPUVolumeRayCastMapper")
    assert actor.mapper.scalar_range == smart.scalar_range
    assert actor.mapper.lookup_table is smart.lookup_table
    assert actor.mapper.dataset is not None
    plotter.render()
    assert np.array_equal(plotter.image, look)
    plotter.entire.detach()
    assert actor.mapper is smart
    plotter.render()
    assert np.array_equal(plotter.image, look)
    assert "screenshot" not in plotter.__dict__


def test_a_data_set_that_is_exchanged_while_held_stays(shown):
    plotter, actor = shown
    smart = actor.mapper
    plotter.entire.hold(fps=1000)
    other = actor.mapper.GetInputDataObject(0, 0).copy()
    actor.mapper.SetInputData(other)
    plotter.render()
    plotter.entire.detach()
    assert actor.mapper is smart
    assert smart.GetInputDataObject(0, 0) is other


def test_screenshots_in_the_midst_of_a_drag_are_at_full_quality(shown):
    plotter, actor = shown
    plotter.entire.hold(fps=1000)
    for k in drag(plotter, 5):
        assert plotter.entire.steering.sample_distance > 1
        if k == 3:
            moving = plotter.screenshot()
            pose = plotter.camera_position
    plotter.entire.detach()
    plotter.camera_position = pose
    plotter.render()
    assert np.array_equal(plotter.screenshot(), moving)


def test_removed_volumes_leave_nothing(image):
    plotter = pv.Plotter(window_size=(240, 240))
    plotter.add_volume(image, name="v", scalars="values")
    plotter.show(auto_close=False, interactive=False)
    plotter.entire.hold(fps=30)
    plotter.render()
    assert len(plotter.scalar_bars) == 1
    steering = plotter.entire.steering
    with pytest.raises(ValueError, match="coarsest"):
        plotter.entire.hold(20, coarsest=-1)
    assert plotter.entire.steering is steering
    plotter.remove_actor("v")
    assert len(plotter.scalar_bars) == 0
    plotter.close()


def test_a_loop_off_screen(image, caplog):
    plotter = pv.Plotter(off_screen=True, window_size=(240, 240))
    plotter.add_volume(image, mapper="gpu", show_scalar_bar=False)
    plotter.show(auto_close=False)
    steering = plotter.entire.hold(fps=1000)
    plotter.render()
    assert "still" in steering.why
    # One log message names the option that steers such a loop.
    for _ in range(30):
        plotter.render()
    assert len([r for r in caplog.records if "always=True" in r.getMessage()]) == 1
    assert "always=True" in repr(steering)
    steering = plotter.entire.hold(fps=1000, always=True)
    for azimuth in range(0, 40, 5):
        plotter.camera.azimuth = azimuth
        plotter.render()
    assert steering.steered_frames >= 8
    coarse = np.array(plotter.image)
    kept = plotter.screenshot()
    assert not np.array_equal(coarse, kept)
    plotter.entire.detach()
    plotter.render()
    assert np.array_equal(plotter.screenshot(), kept)
    plotter.close()


@pytest.mark.parametrize("mapper", ["smart", "gpu", "fixed_point", "open_gl"])
def test_every_mapper_of_images(image, mapper):
    plotter = pv.Plotter(off_screen=True, window_size=(200, 200))
    try:
        plotter.add_volume(image, mapper=mapper)
    except (TypeError, ValueError) as error:
        pytest.skip(f"this PyVista makes no {mapper} mapper: {error}")
    plotter.show(auto_close=False)
    steering = plotter.entire.hold(fps=500, always=True)
    for _ in range(4):
        plotter.render()
    assert steering.status == ""
    plotter.close()


def test_an_unstructured_grid_says_why(image):
    plotter = pv.Plotter(off_screen=True)
    small = image.extract_subset((0, 8, 0, 8, 0, 8)).cast_to_unstructured_grid()
    plotter.add_volume(small, scalars="values", mapper="ugrid")
    with pytest.raises(entire.CannotSteer, match="resample"):
        plotter.entire.hold(fps=30)
    plotter.close()


def test_a_clip_plane_widget(shown):
    plotter, actor = shown
    plotter.entire.hold(fps=1000)
    plotter.add_volume_clip_plane(actor)
    assert actor.mapper.IsA("vtkGPUVolumeRayCastMapper")
    clipped = plotter.screenshot()
    for _ in drag(plotter, 5, at=(10, 10)):
        pass
    assert plotter.entire.steering.fallback_frames == 0
    widget = getattr(plotter, "widgets", plotter).plane_widgets[0]
    widget.SetOrigin(10, 24, 24)
    widget.InvokeEvent("EndInteractionEvent")
    plotter.render()
    moved = plotter.screenshot()
    assert not np.array_equal(clipped, moved)
    plotter.entire.detach()
    assert (
        actor.mapper.GetNumberOfClippingPlanes()
        if hasattr(actor.mapper, "GetNumberOfClippingPlanes")
        else True
    )
    plotter.render()
    assert np.array_equal(plotter.screenshot(), moved)


def test_blocks(image):
    blocks = pv.MultiBlock(
        [image.extract_subset((0, 24, 0, 47, 0, 47)), image.extract_subset((24, 47, 0, 47, 0, 47))]
    )
    plotter = pv.Plotter(off_screen=True, window_size=(240, 240))
    plotter.add_volume(blocks, scalars="values", show_scalar_bar=False)
    plotter.show(auto_close=False)
    steering = plotter.entire.hold(fps=1000, always=True)
    for azimuth in range(0, 30, 5):
        plotter.camera.azimuth = azimuth
        plotter.render()
    assert len(steering.leaves) == 2
    assert all(leaf.status == "" for leaf in steering.leaves)
    plotter.close()


@pytest.mark.parametrize(("mapper", "kind"), windows.PYVISTA_CASES, ids=str)
def test_passes_share_the_time_of_a_frame(mapper, kind):
    windows.check("pyvista", mapper, kind)


def test_renderers_of_their_own(image):
    plotter = pv.Plotter(shape=(1, 2), off_screen=True, window_size=(300, 150))
    for column in range(2):
        plotter.subplot(0, column)
        plotter.add_volume(image)
        plotter.entire.hold(fps=200, always=True)
    plotter.show(auto_close=False)
    for _ in range(4):
        plotter.render()
    for column in range(2):
        plotter.subplot(0, column)
        assert plotter.entire.steering.steered_frames >= 4
    plotter.close()
    assert "nothing" in repr(plotter.entire)


def test_volumes_of_one_renderer_with_calls_of_their_own(image):
    plotter = pv.Plotter(off_screen=True, window_size=(240, 240))
    first = plotter.add_volume(image, mapper="gpu", show_scalar_bar=False)
    second = plotter.add_volume(image.copy(), mapper="fixed_point", show_scalar_bar=False)
    plotter.show(auto_close=False)
    one = plotter.entire.hold(fps=1000, volume=first, always=True)
    two = plotter.entire.hold(fps=1000, volume=second, always=True)
    for azimuth in range(0, 20, 5):
        plotter.camera.azimuth = azimuth
        plotter.render()
    assert one.steered_frames >= 3 and two.steered_frames >= 3
    assert plotter.entire.steering is two
    # A refused call of hold() does not end the earlier steering.
    grid = plotter.add_volume(pv.UnstructuredGrid(image.cast_to_unstructured_grid()), show_scalar_bar=False)
    with pytest.raises(entire.CannotSteer):
        plotter.entire.hold(fps=1000, volume=[first, grid], always=True)
    assert [leaf.volume for leaf in one.leaves] == [first]
    # A call for a volume takes it from its steering.
    again = plotter.entire.hold(fps=500, volume=first, always=True)
    assert one.leaves == [] and [leaf.volume for leaf in again.leaves] == [first] and two.leaves
    plotter.entire.detach()
    assert again.leaves == [] and two.leaves == []
    plotter.close()


def test_misuse_is_said(image):
    plotter = pv.Plotter(off_screen=True)
    with pytest.raises(ValueError, match="no volume"):
        plotter.entire.hold()
    plotter.add_volume(image)
    for bad in ({"fps": 0}, {"fps": -5}, {"seconds": 0.0}):
        with pytest.raises(ValueError, match="positive"):
            plotter.entire.hold(**bad)
    with pytest.raises(ValueError, match="one of them"):
        plotter.entire.hold(30, seconds=0.1)
    plotter.close()


def test_a_warning_names_the_line_of_the_application(shown):
    with pytest.warns(UserWarning, match="clock") as warned:
        shown[0].entire.hold(fps=30, model="unshaded-selected")
    assert warned[0].filename == __file__


def test_calibrating_puts_everything_back(shown):
    plotter, actor = shown
    smart, look = actor.mapper, plotter.screenshot()
    model = plotter.entire.calibrate(frames=12)
    assert model.predicts
    assert actor.mapper is smart
    # The smart mapper is also restored after a steering that ended without plotter.entire.detach().
    plotter.entire.hold(fps=30).detach()
    assert plotter.entire.calibrate(frames=12, pictures=0).predicts
    assert actor.mapper is smart
    plotter.render()
    assert np.array_equal(plotter.screenshot(), look)


def test_calibrating_leaves_other_steerings_alone(shown, image):
    plotter, first = shown
    second = plotter.add_volume(image, scalars="values", show_scalar_bar=False)
    held = plotter.entire.hold(fps=30, volume=second)
    smart = first.mapper
    assert plotter.entire.calibrate(frames=10, pictures=0).predicts
    assert first.mapper is smart
    assert [leaf.volume for leaf in held.leaves] == [second]
    plotter.entire.detach()
    held = entire.vtk.hold(plotter.renderer, seconds=0.1)
    assert plotter.entire.calibrate(frames=10, pictures=0).predicts
    assert len(held.leaves) == 2
