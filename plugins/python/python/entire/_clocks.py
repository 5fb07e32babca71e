# SPDX-License-Identifier: MIT OR Apache-2.0
"""The clocks that time frames, and their comparison with the clock whose times the model predicts."""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable

from ._core import Session

# Functions that read each clock.
_TIMERS: dict[str, Callable[[], float]] = {"wall": time.perf_counter, "cpu": time.process_time}


def timer(clock: str) -> Callable[[], float]:
    """Returns the function that reads a clock, in seconds."""
    if clock not in _TIMERS:
        raise ValueError(f"clock is {clock!r}; it must be 'wall' or 'cpu' (processor time of this process)")
    return _TIMERS[clock]


def difference(session: Session) -> str:
    """Returns a warning if the model predicts seconds of another clock than the clock that times the frames, else "".

    vtkEntireSteering gives the same warning.
    """
    own, model = session.clock, session.model_clock
    if own is None or model is None or own == model:
        return ""
    return (
        f"the model predicts seconds of the {model} clock, but frames are timed by the {own} clock: the model's scale "
        f'is learned from the first frames; "entire calibrate --data TABLE --clock {own}" makes a model of the {own} clock'
    )


def warn(session: Session, also: str = "") -> None:
    """Warns if the two clocks differ. `also` is added to the text. The warning names the application's line that
    called this package."""
    text = difference(session)
    if text:
        level, frame = 1, sys._getframe()
        while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith("entire."):
            level, frame = level + 1, frame.f_back
        warnings.warn(text + also, stacklevel=level)


def both(session: Session) -> str:
    """Text about both clocks, for a holder's `repr`."""
    model = session.model_clock
    return f"{session.clock} clock" + ("" if model is None else f", model of the {model} clock")
