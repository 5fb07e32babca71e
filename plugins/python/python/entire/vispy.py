# SPDX-License-Identifier: MIT OR Apache-2.0
"""Holds vispy's volume visuals to a frame time, by their ``relative_step_size``.

::

    holder = entire.vispy.hold(canvas, volume_visual, seconds=1 / 30)
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from vispy.gloo import gl

from . import _clocks
from ._core import PROBE_SIDE, PROBE_TOLERANCE, CannotSteer, ModelLike, Session, explain
from ._history import History
from ._native import Camera, Plan, TransferFunction, Volume

# Accumulated opacity at which a ray stops, by vispy's rendering method. Methods that are not listed take every sample.
_STOPPING = {"translucent": 0.99, "iso": 0.99, "attenuated_mip": 0.99}


def _matrix(visual: Any) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Matrix, for column vectors, from the visual's coordinates to clip coordinates."""
    transform = visual.transforms.get_transform("visual", "render")
    # The transform is linear in homogeneous coordinates, so the images of the four unit vectors are its columns.
    mapped = np.asarray(transform.map(np.eye(4)), np.float64)
    return mapped.T


class Holder:
    """Holds one visual. Made by :func:`hold`.

    Attributes
    ----------
    seconds : float
        Target time of a frame of the canvas, in seconds.
    enabled : bool
        True if frames are steered.
    moving : callable
        Returns true if the current frame belongs to a motion; other frames are drawn at the visual's own step.
    session : entire.Session
        Session that plans the frames.
    measured, predicted : float
        Measured and expected seconds of the last frame; NaN if unknown.
    step : float
        Ray step of the last frame, in voxels.
    """

    def __init__(
        self,
        canvas: Any,
        visual: Any,
        seconds: float,
        model: ModelLike | None,
        coarsest: float,
        moving: Callable[[], bool],
    ) -> None:
        if not (math.isfinite(seconds) and seconds > 0):
            raise ValueError(
                f"seconds is {seconds}; it must be finite and positive (1 / 30 for 30 frames per second)"
            )
        if not hasattr(visual, "relative_step_size"):
            raise CannotSteer(
                f"{type(visual).__name__} has no relative_step_size; vispy's Volume visual can be "
                f"steered, but not planes and images, which draw one "
                "sample per pixel"
            )
        self.canvas, self.visual, self.seconds, self.moving = canvas, visual, seconds, moving
        self.enabled = True
        self.session = Session(
            model=model, tolerance=0.25, miss_rate=0.02, probe_side=PROBE_SIDE, probe_tolerance=PROBE_TOLERANCE
        )
        self.session.set_timing_source(f"vispy.{type(visual).__name__}", "wall")
        _clocks.warn(self.session)
        self.coarsest = coarsest
        self.measured = self.predicted = self.step = math.nan
        self.reason, self.status = "", "no frame was drawn yet"
        self.own: float = visual.relative_step_size
        self._data: Any = None
        self._shape: Any = None
        self._limits: tuple[float, ...] = ()
        self._method: Any = None
        self._tf: TransferFunction | None = None
        self._plan: Plan | None = None
        self._explained: Plan | None = None
        self._camera: Camera | None = None
        self._began = math.nan
        self._wrote: float | None = None
        canvas.events.draw.connect(self._before, position="first")
        canvas.events.draw.connect(self._after, position="last")

    def detach(self) -> None:
        """Releases the visual and restores its own step."""
        self.canvas.events.draw.disconnect(self._before)
        self.canvas.events.draw.disconnect(self._after)
        self._restore()

    @property
    def history(self) -> History:
        """History : The last frames."""
        return self.session.history

    @property
    def why(self) -> str:
        """str : Reason for the last frame's settings, in a sentence."""
        return self.status or (explain(self._explained) if self._explained else "")

    def __repr__(self) -> str:
        return (
            f"Holder({type(self.visual).__name__} to {1e3 * self.seconds:.1f} ms, {_clocks.both(self.session)}: "
            f"{self.why})"
        )

    def _repr_html_(self) -> str:
        return self.history._repr_html_()

    def _restore(self) -> None:
        if self._wrote is not None and self.visual.relative_step_size == self._wrote:
            self.visual.relative_step_size = self.own
        self._wrote = None

    def _before(self, _event: Any) -> None:
        self._plan = None
        self._restore()
        self.own = self.visual.relative_step_size
        if not self.visual.visible or getattr(self.visual, "parent", self) is None:
            self.reason, self.status, self.predicted = "hidden", "the visual is not drawn", math.nan
            self._began = math.nan
            return
        try:
            self._choose()
        except Exception as error:  # The frame is drawn even if its prediction fails.
            self.reason, self.status = "fallback", str(error)
        self.predicted = math.nan if self._plan is None else self._plan.seconds
        gl.glFinish()
        self._began = time.perf_counter()

    def _after(self, _event: Any) -> None:
        gl.glFinish()
        self.measured = time.perf_counter() - self._began
        # The step is restored between frames, so that renderings to an image have full quality.
        self._restore()
        plan, self._plan = self._plan, None
        if plan is not None:
            try:
                self.session.observe(plan, self.measured)
            except ValueError:
                pass

    def _scene(self) -> tuple[Camera, TransferFunction | None, float]:
        visual = self.visual
        data = getattr(visual, "_last_data", None)
        if data is None:
            raise CannotSteer("the visual has no data yet; call set_data first")
        method, limits = visual.method, tuple(float(c) for c in visual.clim)
        # Each call of set_data stores a new tuple, also if its argument is the same array with other voxels.
        shape = getattr(visual, "_vol_shape", None)
        if data is not self._data or shape is not self._shape or limits != self._limits:
            values = np.asarray(data)
            self._volume = Volume(
                values if values.ndim == 3 else values[..., 0], range=(min(limits), max(limits))
            )
            self.session.set_volume(self._volume)
            self._data, self._shape, self._limits, self._method = data, shape, limits, None
        if method != self._method:
            # A substitute for the method's own opacities: with early termination, opacity grows with the value;
            # otherwise every sample is taken, so all are nearly transparent.
            most = 0.2 if method in _STOPPING else 1e-3
            self._method, self._tf = method, TransferFunction.points([(0, 1e-3), (1, most)])
        # In the visual's coordinates the first voxel spans 0 to 1, so its center, the origin of Volume's coordinates,
        # is at 0.5.
        half = np.eye(4)
        half[:3, 3] = 0.5
        return Camera.projection(self._volume, _matrix(visual) @ half), self._tf, _STOPPING.get(method, 1.0)

    def _choose(self) -> None:
        camera, tf, end = self._scene()
        if self._camera is not None and camera.jumps_from(self._camera):
            self.session.mark(camera=True)
        self._camera = camera
        size = [int(n) for n in self.canvas.physical_size]
        own = min(4096.0, max(1 / 64, float(self.own)))
        steered = self.enabled and self.moving()
        if steered:
            self.session.set_limits(own, max(own, self.coarsest))
        self.session.set_enabled(steered)
        plan = self.session.plan(camera, tf, size, self.seconds, step=own, skipping="none", termination=end)
        self._plan, self.step = plan, plan.step
        if not steered:
            self.reason = "still" if self.enabled else "off"
            self.status = "a still frame, at the visual's own step" if self.enabled else "steering is off"
            return
        self._explained = plan
        self.reason, self.status = plan.reason, ""
        self.visual.relative_step_size = plan.step
        self._wrote = self.visual.relative_step_size


def hold(
    canvas: Any,
    visual: Any,
    seconds: float = 1 / 30,
    *,
    model: ModelLike | None = None,
    coarsest: float = 8.0,
    moving: Callable[[], bool] = lambda: True,
) -> Holder:
    """Holds a vispy volume visual to a frame time.

    After a change of voxels in place, call the visual's ``set_data``: vispy and the holder then read them again.

    Parameters
    ----------
    canvas : vispy.scene.SceneCanvas
    visual : vispy.scene.visuals.Volume
    seconds : float, optional
        Target time of a frame of the canvas. Default 1 / 30.
    model : Model, str, os.PathLike or bytes, optional
        As in :class:`entire.Session`. Frames are timed by the wall clock; if the model's clock
        (``entire.clock`` in its metadata) differs, a warning says that the model's scale is learned from the first
        frames.
    coarsest : float, optional
        Coarsest step in voxels. Default 8.
    moving : callable, optional
        Returns true if a frame is to be steered; other frames are drawn at the visual's own step, with
        the same pixels as without steering. Default: all frames are steered.

    Returns
    -------
    Holder

    Raises
    ------
    CannotSteer
        For a visual without a step.
    ValueError
        For seconds that are not positive.
    """
    return Holder(canvas, visual, seconds, model, coarsest, moving)
