# SPDX-License-Identifier: MIT OR Apache-2.0
"""A window's frame, shared by all that steer in the window by the same clock."""

from __future__ import annotations

import weakref
from typing import Any

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
    """

    __slots__ = ("__weakref__", "budget", "drawing", "start", "usual")

    def __init__(self) -> None:
        self.budget = FrameBudget()
        self.drawing = False
        self.start = 0.0
        self.usual = True


def frame_of(window: Any, clock: str) -> WindowFrame:
    """The frame of a window and a clock; a new one without a window."""
    if window is None:
        return WindowFrame()
    return _frames.setdefault((window.__this__, clock), WindowFrame())
