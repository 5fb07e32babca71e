# SPDX-License-Identifier: MIT OR Apache-2.0
"""Predicts the time of a volume-rendered frame, and holds renderers to a frame time.

With PyVista::

    pl = pv.Plotter()
    pl.add_volume(v)
    pl.entire.hold(fps=30)

With plain VTK, use :func:`entire.vtk.hold`; with any other renderer, :class:`Session`. :func:`predict` predicts the
times of many views without a renderer.
"""

from __future__ import annotations

from ._core import Calibrated, CannotSteer, Model, Session, models, predict
from ._history import History
from ._native import (
    Camera,
    MissingInputError,
    ModelError,
    NotReadyError,
    Plan,
    Prediction,
    RejectedObservationError,
    TransferFunction,
    Volume,
    __version__,
    simd_level,
)

__all__ = [
    "Calibrated",
    "Camera",
    "CannotSteer",
    "History",
    "MissingInputError",
    "Model",
    "ModelError",
    "NotReadyError",
    "Plan",
    "Prediction",
    "RejectedObservationError",
    "Session",
    "TransferFunction",
    "Volume",
    "__version__",
    "models",
    "predict",
    "simd_level",
]
