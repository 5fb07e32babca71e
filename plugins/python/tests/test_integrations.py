# SPDX-License-Identifier: MIT OR Apache-2.0
"""trame, yt and the examples: each drawn for real, and what cannot be steered says why."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import entire

EXAMPLES = Path(__file__).parent.parent / "examples"


def example(name, *arguments, timeout=240):
    run = subprocess.run(
        [sys.executable, EXAMPLES / name, *arguments], capture_output=True, text=True, timeout=timeout
    )
    assert run.returncode == 0, run.stderr[-2000:]
    return run.stdout


def test_example_of_any_renderer():
    assert "60 frames" in example("any_renderer.py")


def test_example_of_vtk(tmp_path):
    pytest.importorskip("vtkmodules")
    assert "80 frames" in example("vtk_hold.py", tmp_path / "history.svg")
    assert (tmp_path / "history.svg").read_text().startswith("<svg")


def test_trame_counts_the_encoding(voxels):
    pytest.importorskip("trame_vtk")
    pytest.importorskip("pyvista")
    import entire.trame
    import entire.vtk
    from trame_vtk.modules.vtk.protocols.publish_image_delivery import vtkWebPublishImageDelivery
    from vtkmodules.vtkWebCore import vtkWebApplication

    from scenes import View, add_volume

    view = View((400, 300))
    volume = add_volume(view.renderer, voxels)
    steering = entire.vtk.hold(view.renderer, volume, 0.5)
    entire.trame.watch(steering)
    application = vtkWebApplication()

    class Delivery(vtkWebPublishImageDelivery):
        app = application

        def get_view(self, _name):
            return view.window

        def get_global_id(self, _window):
            return "1"

    delivery = Delivery(decode=False)
    for degrees in range(0, 80, 10):
        view.orbit(degrees, 110)
        application.InvalidateCache(view.window)
        reply = delivery.still_render({"view": "1", "mtime": 0, "quality": 90})
    assert reply["size"] == (400, 300)
    assert len(steering._outside) == 5
    assert 0 < steering._outside_time < 10
    before = steering.history.target[-1]
    for _ in range(5):
        steering.also(0.3)
    view.draw(1)
    assert steering.history.target[-1] < before


def test_yt(tmp_path):
    pytest.importorskip("yt")
    out = example("yt_hold.py")
    assert "9 frames" in out
    assert "samples per cell" in out


def test_yt_scenes_that_cannot_be_steered():
    yt = pytest.importorskip("yt")
    import entire.yt

    yt.set_log_level(50)
    data = yt.load_uniform_grid({("stream", "density"): np.ones((8, 8, 8))}, (8, 8, 8), nprocs=1)
    scene = yt.create_scene(data, ("stream", "density"), lens_type="fisheye")
    with pytest.raises(entire.yt.CannotSteer, match="field of view"):
        entire.yt.hold(scene, 1.0)
    empty = yt.visualization.volume_rendering.api.Scene()
    with pytest.raises(entire.yt.CannotSteer, match="no volume source"):
        entire.yt.hold(empty, 1.0)
