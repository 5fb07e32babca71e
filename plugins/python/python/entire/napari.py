# SPDX-License-Identifier: MIT OR Apache-2.0
"""Holds napari's 3D view of an image layer to a frame time while the camera moves.

::

    holder = entire.napari.hold(viewer, seconds=1 / 30)
"""

from __future__ import annotations

import time
from typing import Any

from qtpy.QtCore import QTimer

from ._core import CannotSteer, ModelLike
from .vispy import Holder
from .vispy import hold as _hold

# Time in seconds that must pass after the camera's last move before the view counts as still.
_REST = 0.25


def _canvas(viewer: Any) -> Any:
    window = getattr(viewer, "window", None)
    qt = getattr(window, "_qt_viewer", None)
    canvas = getattr(qt, "canvas", None)
    if canvas is None:
        raise CannotSteer("the viewer has no window; make it with napari.Viewer(), not ViewerModel()")
    return canvas


def hold(
    viewer: Any,
    layer: Any = None,
    seconds: float = 1 / 30,
    *,
    model: ModelLike | None = None,
    coarsest: float = 8.0,
) -> Holder:
    """Holds the 3D view of an image layer to a frame time while its camera moves.

    A quarter of a second after the last move, the view is drawn once more at the layer's own step. Screenshots are
    always drawn at that step.

    Parameters
    ----------
    viewer : napari.Viewer
    layer : napari.layers.Image, optional
        Default: the topmost visible image layer.
    seconds, model, coarsest
        As in :func:`entire.vispy.hold`.

    Returns
    -------
    entire.vispy.Holder

    Raises
    ------
    CannotSteer
        If the viewer shows slices, or the layer is not a volume.
    """
    if viewer.dims.ndisplay != 3:
        raise CannotSteer(
            "the viewer shows 2D slices, which draw one sample per pixel; set viewer.dims.ndisplay = 3 first"
        )
    if layer is None:
        layer = next(
            (each for each in reversed(viewer.layers) if each.visible and type(each).__name__ == "Image"),
            None,
        )
        if layer is None:
            raise CannotSteer("the viewer shows no image layer; add one with viewer.add_image")
    if getattr(layer, "depiction", "volume") != "volume":
        raise CannotSteer(
            "the layer is depicted as a plane, which draws few samples; set layer.depiction = 'volume'"
        )
    canvas = _canvas(viewer)
    visuals = getattr(canvas, "layer_to_visual", None) or viewer.window._qt_viewer.layer_to_visual
    node = visuals[layer].node
    state = {"moved": -1e9}
    scene = canvas._scene_canvas
    holder = _hold(
        scene,
        node,
        seconds,
        model=model,
        coarsest=coarsest,
        moving=lambda: time.perf_counter() - state["moved"] < _REST,
    )
    timer = QTimer()
    timer.setSingleShot(True)
    timer.setInterval(int(1e3 * _REST) + 20)
    timer.timeout.connect(scene.update)

    def moved(_event: Any = None) -> None:
        state["moved"] = time.perf_counter()
        timer.start()

    events = (viewer.scene if hasattr(viewer, "scene") else viewer).camera.events
    watched = (events.angles, events.zoom, events.center)
    for emitter in watched:
        emitter.connect(moved)
    plain_detach = holder.detach

    def detach() -> None:
        timer.stop()
        for emitter in watched:
            emitter.disconnect(moved)
        plain_detach()

    holder.detach = detach  # type: ignore[method-assign]
    return holder


__all__ = ["Holder", "hold"]
