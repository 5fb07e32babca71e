# SPDX-License-Identifier: MIT OR Apache-2.0
"""Weak references to VTK objects."""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable
from typing import Any

from vtkmodules.vtkCommonCore import vtkWeakReference


def weak(target: Any = None) -> Callable[[], Any]:
    """Weak reference to a VTK object: a function that returns the object, or None once it is deleted."""
    reference = vtkWeakReference()
    if target is not None:
        reference.Set(target)
    get: Callable[[], Any] = reference.Get
    if sys.version_info >= (3, 12):
        return get

    # Get() makes a wrapper of the object before it owns the object. Up to Python 3.11, making a wrapper may start a
    # garbage collection, which may delete the object if only garbage owns it.
    def get_uncollected() -> Any:
        if not gc.isenabled():
            return get()
        gc.disable()
        try:
            return get()
        finally:
            gc.enable()

    return get_uncollected
