# SPDX-License-Identifier: MIT OR Apache-2.0
"""vispy and napari in windows of Qt with real drawing; refusals name their reason."""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("PyQt6")
pytest.importorskip("vispy")

import entire

# A target in seconds that no machine can meet, so that steering coarsens as far as it is allowed.
TOO_LITTLE = 1e-6


@pytest.fixture
def canvas(voxels):
    os.environ.setdefault("QT_QPA_PLATFORM", "xcb")
    from vispy import app, scene

    try:
        app.use_app("pyqt6")
        made = scene.SceneCanvas(size=(300, 300), show=True)
    except Exception as error:
        pytest.skip(f"Qt opens no window here: {error}")
    view = made.central_widget.add_view()
    visual = scene.visuals.Volume(
        voxels.astype(np.float32), parent=view.scene, method="translucent", clim=(0, 255)
    )
    view.camera = scene.cameras.TurntableCamera(fov=45, distance=120, center=(24, 24, 24), parent=view.scene)
    app.process_events()
    yield made, view, visual
    made.close()
    app.process_events()


def test_examples_of_vispy_and_napari(tmp_path):
    """Each example is steered during a motion; the script fails otherwise."""
    script = Path(__file__).parent.parent / "examples" / "pictures.py"
    run = subprocess.run(
        [sys.executable, script, "--environment", "qt", "--out", tmp_path],
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert run.returncode == 0, run.stderr[-2000:]
    pictures = sorted(tmp_path.iterdir())
    assert [p.stem for p in pictures] == ["python-napari", "python-vispy"]
    assert all(1000 < p.stat().st_size <= 60_000 for p in pictures)


def show(canvas):
    """Draws a canvas's window, as its event loop does."""
    from vispy import app

    canvas.update()
    app.process_events()


def test_vispy(canvas):
    import entire.vispy
    from vispy import scene

    made, view, visual = canvas
    view.camera.azimuth = 0
    plain = made.render()
    own = visual.relative_step_size
    holder = entire.vispy.hold(made, visual, seconds=TOO_LITTLE)
    for azimuth in range(0, 100, 5):
        view.camera.azimuth = azimuth
        show(made)
    assert holder.status == ""
    assert len(holder.history) >= 15
    assert holder.step > 1
    assert holder.reason not in ("still", "fallback")
    # A rendering to an image is at full quality, also between steered frames.
    view.camera.azimuth = 0
    assert np.array_equal(made.render()[..., :3], plain[..., :3])
    assert visual.relative_step_size == own
    holder.moving = lambda: False
    show(made)
    assert holder.reason == "still"
    assert holder.session.clock == "wall" and "wall clock" in repr(holder)
    holder.detach()
    assert visual.relative_step_size == own
    with pytest.warns(UserWarning, match="cpu clock.*wall clock.*first frames"):
        entire.vispy.hold(made, visual, seconds=TOO_LITTLE, model="unshaded-selected").detach()
    frames = len(holder.history)
    show(made)
    assert len(holder.history) == frames
    with pytest.raises(entire.CannotSteer, match="relative_step_size"):
        entire.vispy.hold(made, scene.visuals.Image(np.zeros((4, 4), np.float32), parent=view.scene))


def test_voxels_and_limits_that_change_are_read_again(canvas, voxels):
    import entire.vispy

    made, _view, visual = canvas
    array = np.zeros(voxels.shape, np.float32)
    visual.set_data(array)
    holder = entire.vispy.hold(made, visual, seconds=TOO_LITTLE)
    show(made)
    empty = holder._volume
    assert empty.array is array
    array[:] = voxels
    visual.set_data(array)
    show(made)
    filled = holder._volume
    assert filled is not empty
    show(made)
    assert holder._volume is filled
    # A change of the contrast limits leaves the visual's data alone, but the held volume must get the new range.
    visual.clim = (20, 90)
    show(made)
    assert holder._volume.range == (20, 90)
    holder.detach()


@pytest.mark.parametrize("fov", [0, 45])
def test_cameras_from_vispys_matrices(canvas, fov):
    from vispy import app

    from entire.vispy import _matrix

    made, view, visual = canvas
    view.camera.fov = fov
    view.camera.azimuth, view.camera.elevation = 30, 20
    if fov == 0:
        view.camera.scale_factor = 100
    app.process_events()
    made.render()
    volume = entire.Volume(np.asarray(visual._last_data))
    half = np.eye(4)
    half[:3, 3] = 0.5
    camera = entire.Camera.projection(volume, _matrix(visual) @ half)
    if fov:
        assert camera.fov == pytest.approx(fov, abs=0.1)
        assert camera.pose[2] * volume.radius == pytest.approx(120, rel=0.05)
    else:
        # Parallel rays; the visible height is 100 voxels.
        assert camera.fov is None
        assert 2 * camera.parallel_scale * volume.radius == pytest.approx(100, rel=0.02)


@pytest.fixture
def viewer(voxels):
    napari = pytest.importorskip("napari")
    try:
        made = napari.Viewer(ndisplay=3, show=True)
    except Exception as error:
        pytest.skip(f"napari opens no window here: {error}")
    made.add_image(voxels.astype(np.float32), rendering="translucent", scale=(2, 1, 1))
    yield made
    made.close()


def test_napari(viewer):
    import entire.napari

    camera = (viewer.scene if hasattr(viewer, "scene") else viewer).camera
    canvas = viewer.window._qt_viewer.canvas._scene_canvas
    camera.angles = (0, 0, 90)
    show(canvas)
    plain = viewer.screenshot(canvas_only=True, flash=False)
    holder = entire.napari.hold(viewer, seconds=TOO_LITTLE)
    show(canvas)
    assert holder.reason == "still"
    for angle in range(0, 60, 5):
        camera.angles = (0, angle, 90)
        show(canvas)
    assert len(holder.history) > 8
    assert holder.reason not in ("still", "fallback", "")
    assert holder.step > holder.own
    camera.angles = (0, 0, 90)
    assert np.array_equal(viewer.screenshot(canvas_only=True, flash=False), plain)
    time.sleep(0.4)
    show(canvas)
    assert holder.reason == "still"
    holder.detach()
    assert np.array_equal(viewer.screenshot(canvas_only=True, flash=False), plain)
    viewer.dims.ndisplay = 2
    with pytest.raises(entire.CannotSteer, match="ndisplay"):
        entire.napari.hold(viewer)
    viewer.dims.ndisplay = 3
    viewer.layers[0].depiction = "plane"
    with pytest.raises(entire.CannotSteer, match="depiction"):
        entire.napari.hold(viewer)
