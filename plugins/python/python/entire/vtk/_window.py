# SPDX-License-Identifier: MIT OR Apache-2.0
"""A window's frame, shared by all that steer in the window by the same clock."""

from __future__ import annotations

import weakref
from typing import Any

from vtkmodules.vtkCommonCore import vtkWeakReference

from .._native import FrameBudget

# Frames by the address of their window and the clock. Only steerings keep them alive.
_frames: weakref.WeakValueDictionary[tuple[str, str], WindowFrame] = weakref.WeakValueDictionary()


class WindowFrame:
    """The frame at hand.

    Attributes
    ----------
    budget : FrameBudget
        Divides its time among the passes that draw volumes.
    drawing : bool
        True while the window draws.
    start : float
        Time at which it began.
    usual : bool
        False if it includes the reading of voxels.
    steerings : WeakSet of Steering
        Those that steer in the window.
    """

    __slots__ = ("__weakref__", "budget", "drawing", "start", "steerings", "usual", "window")

    def __init__(self, window: Any) -> None:
        # Another window may get the address of one that is gone.
        self.window = vtkWeakReference()
        self.window.Set(window)
        self.budget = FrameBudget()
        self.drawing = False
        self.start = 0.0
        self.usual = True
        self.steerings: weakref.WeakSet[Any] = weakref.WeakSet()

    def begin(self, now: float) -> None:
        """Begins a frame, for the first of those that steer in the window."""
        if not self.drawing:
            self.drawing = self.usual = True
            self.budget.begin(sum(len(steering.leaves) for steering in self.steerings))
            self.start = now

    def end(self, seconds: float) -> None:
        """Ends the frame, for the first of those that steer in the window."""
        if self.drawing:
            self.drawing = False
            self.budget.end(seconds, self.usual)


def is_picking(window: Any) -> bool:
    """True while a renderer of the window draws for a selector: no frame, it is invisible and takes another time."""
    renderers = window.GetRenderers()
    return any(renderers.GetItemAsObject(i).GetSelector() for i in range(renderers.GetNumberOfItems()))


def frame_of(window: Any, clock: str) -> WindowFrame:
    """The frame of a window and a clock; a new one without a window."""
    if window is None:
        return WindowFrame(None)
    key = (window.__this__, clock)
    frame = _frames.get(key)
    if frame is None or frame.window.Get() is not window:
        frame = _frames[key] = WindowFrame(window)
    return frame
