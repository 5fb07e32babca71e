# SPDX-License-Identifier: MIT OR Apache-2.0
"""A window's frame, shared by all steerings in the window with the same clock."""

from __future__ import annotations

import weakref
from typing import Any

from .._native import FrameBudget
from ._weak import weak

# Frames by the address of their window and their clock. Only steerings keep them alive.
_frames: weakref.WeakValueDictionary[tuple[str, str], WindowFrame] = weakref.WeakValueDictionary()


class WindowFrame:
    """The current frame of a window.

    Attributes
    ----------
    budget : FrameBudget
        Divides the frame's time among the passes that draw volumes.
    drawing : bool
        True while the window draws.
    start : float
        Time at which the frame began, in seconds of the clock.
    usual : bool
        False if the frame includes the reading of voxels.
    steerings : WeakSet of Steering
        The steerings in the window.
    """

    __slots__ = ("__weakref__", "budget", "drawing", "start", "steerings", "usual", "window")

    def __init__(self, window: Any) -> None:
        # frame_of() compares this window with the given one, since a new window may have the address of a deleted one.
        self.window = weak(window)
        self.budget = FrameBudget()
        self.drawing = False
        self.start = 0.0
        self.usual = True
        self.steerings: weakref.WeakSet[Any] = weakref.WeakSet()

    def begin(self, now: float) -> None:
        """Begins a frame; called by every steering in the window, only the first call has an effect."""
        if not self.drawing:
            self.drawing = self.usual = True
            volumes = [leaf.volume for steering in self.steerings for leaf in steering.leaves]
            self.budget.begin(sum(1 for volume in volumes if volume is not None and volume.GetVisibility()))
            self.start = now

    def end(self, seconds: float) -> None:
        """Ends the frame; called by every steering in the window, only the first call has an effect."""
        if self.drawing:
            self.drawing = False
            self.budget.end(seconds, self.usual)


def is_picking(window: Any) -> bool:
    """True while a renderer of the window draws for a selector. Such a drawing is invisible, takes a different time,
    and does not count as a frame."""
    renderers = window.GetRenderers()
    return any(renderers.GetItemAsObject(i).GetSelector() for i in range(renderers.GetNumberOfItems()))


def frame_of(window: Any, clock: str) -> WindowFrame:
    """Returns the frame of a window and a clock; a new frame if `window` is None."""
    if window is None:
        return WindowFrame(None)
    key = (window.__this__, clock)
    frame = _frames.get(key)
    if frame is None or frame.window() is not window:
        frame = _frames[key] = WindowFrame(window)
    return frame
