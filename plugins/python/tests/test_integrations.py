# SPDX-License-Identifier: MIT OR Apache-2.0
"""trame, yt and the examples with real drawing; refusals name their reason."""

import asyncio
import re
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


def test_examples_of_pyvista_and_trame(tmp_path):
    """Each example is steered during a motion; the script fails otherwise."""
    for needed in ("pyvista", "trame_pyvista", "trame_vuetify"):
        pytest.importorskip(needed)
    example("pictures.py", "--environment", "test", "--only", "pyvista,trame", "--out", tmp_path)
    pictures = sorted(tmp_path.iterdir())
    assert [p.stem for p in pictures] == ["python-clip", "python-pyvista", "python-several", "python-trame"]
    assert all(1000 < p.stat().st_size <= 60_000 for p in pictures)


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
    assert 0 < steering.outside_time < 10
    before = steering.history.target[-1]
    for _ in range(5):
        steering.also(0.3)
    view.draw(1)
    assert steering.history.target[-1] < before


def test_trame_end_to_end():
    """The example's server, and a client that drags in its view as a browser does, over the web socket."""
    for needed in ("trame_pyvista", "trame_vuetify", "aiohttp", "msgpack"):
        pytest.importorskip(needed)
    server = subprocess.Popen(
        [sys.executable, "-u", EXAMPLES / "trame_hold.py", "--server", "--port", "0", "--timeout", "5"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        port = next(int(m[1]) for line in server.stdout if (m := re.search(r"localhost:(\d+)", line)))
        pictures = asyncio.run(asyncio.wait_for(drag_in_a_browser(port), 60))
        out, error = server.communicate(timeout=60)
    finally:
        server.kill()
    assert len(pictures) >= 10, error[-2000:]
    assert all(picture.startswith(b"\xff\xd8") for picture in pictures)
    history = re.search(r"History\((\d+) frames", out)
    assert history, error[-2000:]
    assert int(history[1]) >= 10
    encoding = re.search(r"encoding takes ([\d.]+) ms", out)
    assert float(encoding[1]) > 0


async def drag_in_a_browser(port):
    import aiohttp
    import msgpack
    from wslink.chunking import UnChunker, generate_chunks

    pictures, answers = [], {}
    async with aiohttp.ClientSession() as session:
        page = await session.get(f"http://localhost:{port}/")
        assert page.status == 200
        async with session.ws_connect(f"http://localhost:{port}/ws", max_msg_size=0) as socket:
            chunks = UnChunker()
            chunks.set_max_message_size(1 << 30)

            async def call(name, *args):
                key = f"{'system' if name == 'wslink.hello' else 'rpc'}:c0:{len(answers)}"
                message = {"wslink": "1.0", "id": key, "method": name, "args": list(args), "kwargs": {}}
                for chunk in generate_chunks(msgpack.packb(message), 0):
                    await socket.send_bytes(chunk)
                while key not in answers:
                    whole = chunks.process_chunk((await socket.receive()).data)
                    if whole is None:
                        continue
                    if "error" in whole:
                        raise AssertionError(whole["error"])
                    if whole.get("id", "").startswith("publish:viewport.image.push"):
                        pictures.append(whole["result"]["image"])
                    answers[whole["id"]] = whole.get("result")
                return answers[key]

            await call("wslink.hello", {"secret": "wslink-secret"})
            state = await call("trame.state.get")
            view = next(v for k, v in state["state"].items() if k.startswith("view_P_") and k.endswith("Id"))
            await call("viewport.image.push.observer.add", view)
            keys = dict.fromkeys(("shiftKey", "ctrlKey", "altKey", "metaKey", "buttonMiddle", "buttonRight"), 0)
            for k in range(20):
                mouse = {"view": view, "x": 0.3 + 0.02 * k, "y": 0.5, "buttonLeft": 1, **keys}
                await call("viewport.mouse.interaction", {**mouse, "action": "move" if k else "down"})
                await call("viewport.image.push", {"view": view})
                await asyncio.sleep(0.05)
    return pictures


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
    with pytest.raises(entire.CannotSteer, match="field of view"):
        entire.yt.hold(scene, 1.0)
    scene = yt.create_scene(data, ("stream", "density"), lens_type="perspective")
    for smallest in (0, -1, float("nan")):
        with pytest.raises(ValueError, match="smallest"):
            entire.yt.hold(scene, 1.0, smallest=smallest)
    with pytest.raises(ValueError, match="edge is 0"):
        entire.yt.hold(scene, 1.0, edge=0)
    scene[0].transfer_function = yt.visualization.volume_rendering.api.ProjectionTransferFunction()
    with pytest.raises(entire.CannotSteer, match="no opacities"):
        entire.yt.hold(scene, 1.0)
    empty = yt.visualization.volume_rendering.api.Scene()
    with pytest.raises(entire.CannotSteer, match="no volume source"):
        entire.yt.hold(empty, 1.0)


def test_a_yt_picture_of_any_duration_is_returned(monkeypatch):
    yt = pytest.importorskip("yt")
    import entire.yt

    yt.set_log_level(50)
    data = yt.load_uniform_grid({("stream", "density"): np.ones((8, 8, 8)) + np.arange(8)}, (8, 8, 8), nprocs=1)
    scene = yt.create_scene(data, ("stream", "density"), lens_type="perspective")
    scene.camera.resolution = (32, 32)
    holder = entire.yt.hold(scene, 1.0)
    # Each reading of the clock is 20,000 seconds after the previous one. A session rejects such times.
    readings = iter(range(0, 200_000, 20_000))
    monkeypatch.setattr("entire.yt.time.perf_counter", lambda: next(readings))
    assert holder.render().shape[2] == 4
    assert holder.measured == 20_000
    assert len(holder.history) == 0
