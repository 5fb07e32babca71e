# SPDX-License-Identifier: MIT OR Apache-2.0
"""The clock of the frames, and the clock that their model predicts."""

from __future__ import annotations

import warnings

from ._core import Session


def difference(session: Session) -> str:
    """Warning for a model that predicts another clock than the one that times frames; empty where it does not.

    In the words of vtkEntireSteering.
    """
    own, model = session.clock, session.model_clock
    if own is None or model is None or own == model:
        return ""
    return (
        f"the model predicts seconds of the {model} clock, frames are timed by the {own} clock: the model's scale "
        f'is learned from the first frames; "entire train --clock {own}" makes a model of the {own} clock'
    )


def warn(session: Session, also: str = "", *, stacklevel: int) -> None:
    """Warns, and names the ways to make a model of the clock. The caller's own frame is `stacklevel` 1."""
    text = difference(session)
    if text:
        warnings.warn(text + also, stacklevel=stacklevel + 1)


def both(session: Session) -> str:
    """Both clocks, for a holder's representation."""
    model = session.model_clock
    return f"{session.clock} clock" + ("" if model is None else f", model of the {model} clock")
