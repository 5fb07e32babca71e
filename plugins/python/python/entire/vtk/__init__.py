# SPDX-License-Identifier: MIT OR Apache-2.0
"""Holds the volumes of a VTK scene to a frame time, with the VTK of pip (9.3 or newer), conda, a Linux distribution or
ParaView.

::

    steering = entire.vtk.hold(renderer, volume, seconds=1 / 30)
"""

from __future__ import annotations

from ._calibrate import calibrate, rmse
from ._leaf import Leaf
from ._steering import Steering, hold

__all__ = ["Leaf", "Steering", "calibrate", "hold", "rmse"]
