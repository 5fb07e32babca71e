# SPDX-License-Identifier: MIT OR Apache-2.0
"""Draws the book's pictures of the examples, each during a motion: `make python-pictures`.

plugins/python/run.sh exec test python plugins/python/examples/pictures.py --environment test --out FOLDER
"""

import argparse
import importlib
import math
import sys
from pathlib import Path

import numpy as np
from PIL import Image

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))
# Number of colors of a picture; halved until its file is small enough.
COLORS = 160
# Maximum size of a picture's file, bytes.
MOST = 60_000


def save(out, name, pixels):
    picture = Image.fromarray(np.ascontiguousarray(pixels[..., :3]))
    path = out / f"python-{name}.png"
    colors = COLORS
    while True:
        picture.quantize(colors).save(path, optimize=True)
        if path.stat().st_size <= MOST:
            break
        colors //= 2
    print(f"{path.name}: {path.stat().st_size} bytes, {picture.width} x {picture.height}, {colors} colors", flush=True)


def drag(plotter, frames=24, at=(90, 300)):
    """Turns the scene as a mouse does, and stops with the button down."""
    plotter.show(auto_close=False, interactive=False)
    interactor = plotter.render_window.GetInteractor()
    interactor.SetEventInformation(*at, 0, 0)
    interactor.InvokeEvent("LeftButtonPressEvent")
    for k in range(frames):
        interactor.SetEventInformation(at[0] + 4 * k, at[1] - 3 * k, 0, 0)
        interactor.InvokeEvent("MouseMoveEvent")
    for leaf in plotter.entire.steering.leaves:
        if leaf.reason in ("still", "fallback", ""):
            sys.exit(f"not steered: {leaf.why}")


def pyvista(out):
    for name, module in (("pyvista", "three_lines"), ("several", "several_volumes"), ("clip", "clip_plane")):
        plotter = importlib.import_module(module).pl
        drag(plotter)
        save(out, name, plotter.image)
        print(f"  {plotter.entire.steering!r}")
        plotter.close()


def vtk(out):
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkRenderingCore import vtkWindowToImageFilter

    sys.argv[1:] = [str(out / "python-history.svg")]
    example = importlib.import_module("vtk_hold")
    grab = vtkWindowToImageFilter()
    grab.SetInput(example.window)
    grab.ShouldRerenderOff()
    grab.Update()
    shown = grab.GetOutput()
    width, height, _ = shown.GetDimensions()
    save(out, "vtk", vtk_to_numpy(shown.GetPointData().GetScalars()).reshape(height, width, -1)[::-1])


def trame(out):
    """Saves a picture that the server sends to the browser while the scene turns."""
    import io

    from trame_vtk.modules.vtk.protocols.publish_image_delivery import vtkWebPublishImageDelivery
    from vtkmodules.vtkWebCore import vtkWebApplication

    example = importlib.import_module("trame_hold")
    window, steering = example.pl.render_window, example.steering
    # The same image encoding as in trame.
    application = vtkWebApplication()
    application.SetImageEncoding(vtkWebApplication.ENCODING_NONE)
    application.SetImageCompression(vtkWebApplication.COMPRESSION_JPEG)

    class Delivery(vtkWebPublishImageDelivery):
        app = application

        def get_view(self, _name):
            return window

        def get_global_id(self, _window):
            return "1"

    delivery = Delivery(decode=False)
    example.pl.show(auto_close=False, interactive=False)
    steering.always = True
    for k in range(20):
        example.pl.camera.azimuth = 4 * k
        application.InvalidateCache(window)
        reply = delivery.still_render({"view": "1", "mtime": 0, "quality": 90, "size": (480, 360)})
    if steering.status:
        sys.exit(f"not steered: {steering.status}")
    save(out, "trame", np.asarray(Image.open(io.BytesIO(reply["image"])).convert("RGB")))
    print(f"  encoding takes {1e3 * steering.outside_time:.1f} ms of a frame")
    example.pl.close()


def yt(out):
    sys.argv[1:] = [str(out / "yt.png")]
    example = importlib.import_module("yt_hold")
    picture = np.asarray(Image.open(out / "yt.png").convert("RGB"))
    (out / "yt.png").unlink()
    save(out, "yt", picture)
    print(f"  {example.holder.history}")


def vispy(out):
    from vispy import app
    from vispy.gloo.util import _screenshot

    example = importlib.import_module("vispy_hold")
    for k in range(30):
        example.view.camera.azimuth = 4 * k
        example.view.camera.elevation = 20 + 10 * math.sin(k / 5)
        example.canvas.update()
        app.process_events()
    if example.holder.status:
        sys.exit(f"not steered: {example.holder.status}")
    example.canvas.set_current()
    save(out, "vispy", _screenshot())
    print(f"  {example.holder!r}, step {example.holder.step:.2f}")
    example.canvas.close()


def napari(out):
    from PyQt6.QtGui import QImage
    from vispy import app

    example = importlib.import_module("napari_hold")
    viewer = example.viewer
    viewer.window.resize(640, 400)
    camera = (viewer.scene if hasattr(viewer, "scene") else viewer).camera
    camera.zoom *= 0.6
    canvas = viewer.window._qt_viewer.canvas._scene_canvas
    for k in range(30):
        camera.angles = (0, 20 + 3 * k, 70)
        canvas.update()
        app.process_events()
    if example.holder.status:
        sys.exit(f"not steered: {example.holder.status}")
    # The whole window in its current state.
    grabbed = viewer.window._qt_window.grab().toImage().convertToFormat(QImage.Format.Format_RGB888)
    bits = grabbed.constBits()
    bits.setsize(grabbed.sizeInBytes())
    rows = np.frombuffer(bits, np.uint8).reshape(grabbed.height(), grabbed.bytesPerLine())
    save(out, "napari", rows[:, : 3 * grabbed.width()].reshape(grabbed.height(), grabbed.width(), 3))
    print(f"  {example.holder!r}, step {example.holder.step:.2f}")
    viewer.close()


PICTURES = {"test": (pyvista, vtk, trame, yt), "qt": (vispy, napari)}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--environment", choices=PICTURES, required=True, help="environment of run.sh in which this script runs"
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", help="comma-separated: " + ", ".join(f.__name__ for p in PICTURES.values() for f in p))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for draw in PICTURES[options.environment]:
        if not options.only or draw.__name__ in options.only.split(","):
            draw(options.out.resolve())


if __name__ == "__main__":
    main()
