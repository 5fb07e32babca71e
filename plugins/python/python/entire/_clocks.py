# SPDX-License-Identifier: MIT OR Apache-2.0
"""Comparison of the clock that times frames with the clock whose times the model predicts."""

from __future__ import annotations

import warnings

from ._core import Session


def difference(session: Session) -> str:
    """Returns a warning if the model predicts seconds of another clock than the clock that times the frames, else "".

    vtkEntireSteering gives the same warning.
    """
    own, model = session.clock, session.model_clock
    if own is None or model is None or own == model:
        return ""
    return (
        f"the model predicts seconds of the {model} clock, but frames are timed by the {own} clock: the model's scale "
        f'is learned from the first frames; "entire train --clock {own}" makes a model of the {own} clock'
    )


def warn(session: Session, also: str = "", *, stacklevel: int) -> None:
    """Warns if the two clocks differ. `also` is added to the text. `stacklevel` 1 is the caller's frame."""
    text = difference(session)
    if text:
        warnings.warn(text + also, stacklevel=stacklevel + 1)


def both(session: Session) -> str:
    """Text about both clocks, for a holder's `repr`."""
    model = session.model_clock
    return f"{session.clock} clock" + ("" if model is None else f", model of the {model} clock")
