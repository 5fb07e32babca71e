# SPDX-License-Identifier: MIT OR Apache-2.0
"""``plotter.entire``: holds PyVista's plotters to a frame time. PyVista (0.48 or newer) loads this module by itself; it
needs no import."""

from __future__ import annotations

import contextlib
import functools
import sys
from collections.abc import Iterator
from typing import Any

import pyvista as pv

from ._core import Model, ModelLike
from ._history import History
from .vtk import Steering, calibrate, hold
from .vtk._mappers import gpu_in_place_of
from .vtk._steering import _holder, _volumes


def _gpu_wrapper(smart: Any) -> Any:
    """Makes PyVista's own GPU mapper to replace its smart mapper, with the attributes that PyVista sets on a mapper."""
    kind = getattr(pv.plotting.mapper, "OpenGLGPUVolumeRayCastMapper", None)
    if kind is None or not hasattr(smart, "_scalar_range"):
        return gpu_in_place_of(smart)
    wrapped = gpu_in_place_of(smart, make=kind)
    for name, value in smart.__dict__.items():
        if name in ("_lut", "_scalar_range", "_theme"):
            wrapped.__dict__[name] = value
    return wrapped


@pv.register_plotter_component("entire")
class EntireComponent:
    """Holds a plotter's volumes to a frame time.

    Examples
    --------
    >>> pl = pv.Plotter()                                                    # doctest: +SKIP
    >>> pl.add_volume(v)                                                     # doctest: +SKIP
    >>> pl.entire.hold(fps=30)                                               # doctest: +SKIP
    """

    def __init__(self, plotter: Any) -> None:
        self._plotter = plotter
        #: Steerings of each held renderer, by the renderer's index in the plotter, newest last.
        self._held: dict[int, list[Steering]] = {}
        #: The last steering that ended in each renderer.
        self._past: dict[int, Steering] = {}
        self._screenshots: dict[str, Any] = {}

    def _make_gpu(self, smart: Any) -> Any:
        gpu = _gpu_wrapper(smart)
        self._replace(smart, gpu)
        return gpu

    def _replace(self, before: Any, after: Any) -> None:
        """Assigns the scalar bars of `before` to `after`, since PyVista removes scalar bars with their mappers."""
        for mappers in getattr(self._plotter.scalar_bars, "_scalar_bar_mappers", {}).values():
            mappers[:] = [after if mapper is before else mapper for mapper in mappers]

    def _new_steering(self, volume: Any, seconds: float, **options: Any) -> Steering:
        steering = hold(self._plotter.renderer, volume, seconds, make_gpu=self._make_gpu, **options)
        steering._given_back = self._replace
        return steering

    def hold(
        self, fps: float | None = None, *, seconds: float | None = None, volume: Any = None, **options: Any
    ) -> Steering:
        """Holds volumes of the active renderer to a frame rate while the camera or a widget moves.

        PyVista draws still frames, screenshots and movie frames at full quality, with the same pixels as without this
        package.

        Parameters
        ----------
        fps : float, optional
            Frames per second. Default: 30, unless `seconds` is given.
        seconds : float, optional
            Seconds per frame, instead of `fps`.
        volume : pyvista.Volume or sequence of them, optional
            Volumes to hold. Default: all volumes of the renderer, including those that are added later.
        **options
            Options of :func:`entire.vtk.hold`. Loops without interaction (off screen) need
            ``always=True``; otherwise all their frames are still frames.

        Returns
        -------
        entire.vtk.Steering

        Raises
        ------
        ValueError
            For a rate that is not positive, for both `fps` and `seconds`, or for a renderer without volumes.
        entire.CannotSteer
            If a mapper cannot be steered; the text gives the reason.
        """
        if fps is not None and seconds is not None:
            raise ValueError("fps and seconds are both given; pass one of them")
        if seconds is None:
            rate = 30.0 if fps is None else fps
            if not rate > 0:
                raise ValueError(f"fps is {rate}; it must be positive")
            seconds = 1.0 / rate
        index = self._plotter.renderers.active_index
        # The earlier steering ends only after the new one was made, so that it continues if the new one is refused.
        steering = self._new_steering(volume, seconds, **options)
        kept = []
        for earlier in self._held.get(index, []):
            # A call for some volumes leaves the other volumes to their steering.
            if volume is not None and earlier.leaves:
                kept.append(earlier)
            else:
                earlier.detach()
        self._held[index] = [*kept, steering]
        if "trame_vtk" in sys.modules:
            from .trame import watch

            watch(steering)
        self._guard_screenshots()
        return steering

    def calibrate(self, frames: int = 60, *, volume: Any = None, **options: Any) -> Model:
        """Draws random frames of a volume of the active renderer and fits the cost model to them; see
        :func:`entire.vtk.calibrate`.

        Parameters
        ----------
        frames : int, optional
            Number of frames to draw, at least 10. Default 60.
        volume : pyvista.Volume, optional
            Default: the renderer's first volume.
        **options
            Options of :func:`entire.vtk.calibrate`.

        Returns
        -------
        entire.Model
            For ``model=`` of :meth:`hold`.
        """
        self._plotter.render()
        renderer = self._plotter.renderer
        there = _volumes(renderer)
        if volume is None and there:
            volume = there[0]
        if volume not in there or _holder(volume) is not None:
            return calibrate(renderer, volume, frames, **options)
        # A temporary steering, which exchanges a smart mapper during the measurement.
        passing = self._new_steering(volume, 1.0)
        try:
            return calibrate(renderer, volume, frames, **options)
        finally:
            passing.detach()

    @property
    def steering(self) -> Steering | None:
        """entire.vtk.Steering or None : Steering that the last call of :meth:`hold` made for the active renderer. After
        it has ended or the plotter was closed, it has no leaves, but keeps its history and learned state."""
        index = self._plotter.renderers.active_index
        return next(reversed(self._held.get(index, [])), self._past.get(index))

    @property
    def history(self) -> History | None:
        """entire.History or None : The last frames of the active renderer; notebooks show it as plots."""
        return None if self.steering is None else self.steering.history

    @contextlib.contextmanager
    def still(self) -> Iterator[None]:
        """Context in which PyVista draws frames at full quality, with the same pixels as without this package."""
        with contextlib.ExitStack() as stack:
            for steering in self._all():
                stack.enter_context(steering.still())
            yield

    def detach(self) -> None:
        """Releases the active renderer and restores exchanged mappers."""
        self._end(self._plotter.renderers.active_index)

    def _all(self) -> list[Steering]:
        return [steering for steerings in self._held.values() for steering in steerings]

    def _end(self, index: int) -> None:
        for steering in self._held.pop(index, []):
            steering.detach()
            self._past[index] = steering
        if not self._held:
            for name in self._screenshots:
                self._plotter.__dict__.pop(name, None)
            self._screenshots = {}

    def _guard_screenshots(self) -> None:
        """Makes the plotter draw at full quality before it saves a picture, if the last frame was steered."""
        for name in ("screenshot", "write_frame"):
            if name in self._screenshots:
                continue
            original = getattr(self._plotter, name)

            @functools.wraps(original)
            def at_full_quality(*args: Any, _original: Any = original, **kwargs: Any) -> Any:
                coarse = any(
                    leaf.reason not in ("still", "") for s in self._all() for leaf in s.leaves
                )
                with self.still():
                    window = self._plotter.render_window
                    if coarse and window is not None:
                        window.Render()
                    return _original(*args, **kwargs)

            self._screenshots[name] = original
            self._plotter.__dict__[name] = at_full_quality

    def __plotter_close__(self) -> None:
        for index in list(self._held):
            self._end(index)

    def __repr__(self) -> str:
        return "entire: nothing is held" if not self._held else "\n".join(map(repr, self._all()))


__all__ = ["EntireComponent", "ModelLike"]
