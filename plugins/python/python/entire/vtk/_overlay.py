# SPDX-License-Identifier: MIT OR Apache-2.0
"""Three lines of text about the last frame in the corner of the picture."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import vtkmodules.vtkRenderingFreeType  # noqa: F401  (draws text)
from vtkmodules.vtkRenderingCore import vtkTextActor

from ._weak import weak

if TYPE_CHECKING:
    from ._steering import Steering


class Overlay:
    """Text with the expected and measured time, step and reason of the last frame; hidden in still frames."""

    def __init__(self, renderer: Any) -> None:
        self._renderer = weak(renderer)
        self._actor = vtkTextActor()
        self._actor.SetVisibility(0)
        self._actor.SetPickable(0)
        self._actor.SetPosition(8, 8)
        text = self._actor.GetTextProperty()
        text.SetFontFamilyToCourier()
        text.SetFontSize(14)
        text.SetBackgroundColor(0, 0, 0)
        text.SetBackgroundOpacity(0.5)
        renderer.AddViewProp(self._actor)

    def show(self, steering: Steering, moving: bool) -> None:
        self._actor.SetVisibility(int(moving))
        if moving and not math.isnan(steering.frame_time):
            target = "" if steering.seconds is None else f" of {1e3 * steering.seconds:.1f}"
            self._actor.SetInput(
                f"volume: expected {1e3 * steering.predicted:.1f} ms, took {1e3 * steering.measured:.1f} ms\n"
                f"frame: {1e3 * steering.frame_time:.1f}{target} ms\n"
                f"sample distance {steering.sample_distance:.2f}, "
                f"{steering.image_sample_distance:.2f} pixels between rays: "
                f"{steering.reason}"
            )

    def remove(self) -> None:
        renderer: Any = self._renderer()
        if renderer is not None:
            renderer.RemoveViewProp(self._actor)
