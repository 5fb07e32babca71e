# SPDX-License-Identifier: MIT OR Apache-2.0
"""trame's remote views: the time of encoding a picture for the browser is part of its frame.

::

    steering = plotter.entire.hold(fps=20)
    entire.trame.watch(steering)

Views that the browser draws by itself (local ones: vtk.js, VTK.wasm) are out of Python's reach.
"""

from __future__ import annotations

import functools
import time
import weakref
from typing import Any

from trame_vtk.modules.vtk.protocols.publish_image_delivery import vtkWebPublishImageDelivery

from .vtk import Steering

_watched: weakref.WeakSet[Steering] = weakref.WeakSet()


def _count(original: Any) -> Any:
    @functools.wraps(original)
    def still_render(self: Any, options: Any) -> Any:
        window = self.get_view(options["view"])
        steerings = [s for s in _watched if s.renderer is not None and s.renderer.GetRenderWindow() is window]
        drawn = [s.frames for s in steerings]
        before = time.perf_counter()
        reply = original(self, options)
        seconds = time.perf_counter() - before
        for steering, frames in zip(steerings, drawn):
            if steering.frames == frames + 1:
                # Drawing is counted separately; the rest is reading back and encoding.
                steering.also(max(0.0, seconds - steering.frame_time))
        return reply

    still_render._entire_counts = True  # type: ignore[attr-defined]
    return still_render


def watch(steering: Steering) -> None:
    """Counts the encoding of pictures for the browser as part of the frames of a steering.

    The median of the last five is subtracted from the budget of later frames, so that the browser gets the
    target rate.

    Parameters
    ----------
    steering : entire.vtk.Steering
        With the clock "wall".
    """
    if not hasattr(vtkWebPublishImageDelivery.still_render, "_entire_counts"):
        vtkWebPublishImageDelivery.still_render = _count(vtkWebPublishImageDelivery.still_render)
    _watched.add(steering)
