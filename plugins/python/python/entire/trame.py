# SPDX-License-Identifier: MIT OR Apache-2.0
"""Counts the time to encode pictures for the browser as part of the frames of trame's remote views.

::

    steering = plotter.entire.hold(fps=20)
    entire.trame.watch(steering)

Local views, which the browser draws itself (vtk.js, VTK.wasm), cannot be steered from Python.
"""

from __future__ import annotations

import functools
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
        # Each steering has a clock of its own.
        began = [(s, s.frames, s._now()) for s in steerings]
        reply = original(self, options)
        for steering, frames, before in began:
            if steering.frames == frames + 1:
                # The time without the drawing of the frame: reading the picture back and encoding it.
                steering.also(max(0.0, steering._now() - before - steering.frame_time))
        return reply

    still_render._entire_counts = True  # type: ignore[attr-defined]
    return still_render


def watch(steering: Steering) -> None:
    """Counts the time to encode pictures for the browser as part of the frames of a steering.

    The median time of the last five pictures is subtracted from the target of later frames, so that the browser gets
    pictures at the target rate.

    Parameters
    ----------
    steering : entire.vtk.Steering
        The steering; the time is counted by its clock.
    """
    if not hasattr(vtkWebPublishImageDelivery.still_render, "_entire_counts"):
        vtkWebPublishImageDelivery.still_render = _count(vtkWebPublishImageDelivery.still_render)
    _watched.add(steering)
