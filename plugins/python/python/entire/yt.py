# SPDX-License-Identifier: MIT OR Apache-2.0
"""Holds yt's volume rendering to a time per picture: reduces the samples per cell first, then the camera's resolution.

::

    holder = entire.yt.hold(scene, seconds=2.0)
    picture = holder.render()
"""

from __future__ import annotations

import contextlib
import math
import time
from typing import Any

import numpy as np

from . import _clocks
from ._core import CannotSteer, ModelLike, Session, explain
from ._history import History
from ._native import Camera, Plan, TransferFunction, Volume


def _source(scene: Any) -> Any:
    for source in scene.sources.values():
        if hasattr(source, "num_samples"):
            return source
    raise CannotSteer(
        "the scene has no volume source with a number of samples; mesh, line and point sources cannot be steered"
    )


def _fixed_resolution(source: Any, edge: int) -> Volume:
    """Reads the source's field on a regular grid of at most `edge` cells along an axis. If yt draws the logarithm of
    the field, returns a volume of the logarithm."""
    data = source.data_source
    dataset = data.ds
    low, high = (
        np.asarray(v.to_value("code_length")) for v in (dataset.domain_left_edge, dataset.domain_right_edge)
    )
    cells = np.minimum(
        np.asarray(dataset.domain_dimensions) * dataset.refine_by**dataset.index.max_level, edge
    ).astype(int)
    grid = dataset.arbitrary_grid(
        dataset.domain_left_edge, dataset.domain_right_edge, dims=[int(n) for n in cells]
    )
    values = np.asarray(grid[source.field], np.float64)
    if source.log_field:
        with np.errstate(divide="ignore", invalid="ignore"):
            values = np.log10(values)
    bounds = source.transfer_function.x_bounds
    spacing = (high - low) / cells
    return Volume(
        np.asarray(values, np.float32),
        (float(spacing[0]), float(spacing[1]), float(spacing[2])),
        origin=tuple(float(v) for v in low + 0.5 * spacing),
        axes="xyz",
        range=(float(bounds[0]), float(bounds[1])),
    )


class Holder:
    """Renders pictures of a scene within a target time. Made by :func:`hold`.

    Attributes
    ----------
    seconds : float
        Target time of a picture, in seconds.
    session : entire.Session
        Session that plans the pictures.
    samples : int
        Samples per cell of the last picture.
    resolution : (int, int)
        Width and height of the last picture, in pixels.
    measured, predicted : float
        Measured and expected seconds of the last picture; NaN before the first.
    """

    def __init__(
        self, scene: Any, seconds: float, model: ModelLike | None, smallest: float, edge: int
    ) -> None:
        if not (math.isfinite(seconds) and seconds > 0):
            raise ValueError(f"seconds is {seconds}; it must be finite and positive")
        if not smallest > 0:
            raise ValueError(f"smallest is {smallest}; it must be positive (1 for the full side)")
        if edge < 1:
            raise ValueError(f"edge is {edge} cells; it must be at least 1")
        self.scene, self.seconds = scene, seconds
        self.source = _source(scene)
        lens = type(scene.camera.lens).__name__
        if lens not in ("PerspectiveLens", "PlaneParallelLens"):
            raise CannotSteer(
                f"{lens} has no single field of view; use a perspective or plane-parallel lens"
            )
        function = self.source.transfer_function
        if not hasattr(function, "alpha"):
            raise CannotSteer(f"{type(function).__name__} has no opacities; use a ColorTransferFunction")
        self.volume = _fixed_resolution(self.source, edge)
        self.session = Session(self.volume, model=model, tolerance=0.25)
        self.session.set_timing_source(f"yt.{type(self.source).__name__}", "wall")
        _clocks.warn(self.session)
        width, height = (int(n) for n in scene.camera.resolution)
        self.most, self.full = int(self.source.num_samples), (width, height)
        self.smallest = smallest
        self.samples, self.resolution = self.most, self.full
        self.measured = self.predicted = math.nan
        self._plan: Plan | None = None

    def _camera(self) -> Camera:
        camera = self.scene.camera
        unit = "code_length"
        position, focus = (np.asarray(v.to_value(unit)) for v in (camera.position, camera.focus))
        width = np.asarray(camera.width.to_value(unit))
        north = np.asarray(camera.unit_vectors[1])
        if type(camera.lens).__name__ == "PerspectiveLens":
            fov = 2 * math.degrees(math.atan(0.5 * width[1] / width[2]))
            eye = position
        else:
            # A plane-parallel view is approximated by a distant eye with a narrow field of view.
            fov = 2.0
            forward = np.asarray(camera.unit_vectors[2])
            eye = focus - forward / np.linalg.norm(forward) * (0.5 * width[1] / math.tan(math.radians(1.0)))
        at = tuple(float(v) for v in eye)
        return Camera.look_at(
            self.volume, at, tuple(float(v) for v in focus), tuple(float(v) for v in north), fov
        )

    def _function(self) -> TransferFunction:
        alpha = np.clip(np.asarray(self.source.transfer_function.alpha.y, np.float64), 0, 1)
        # yt's opacities apply to one unit of length along a ray.
        return TransferFunction.table(np.clip(alpha, 1e-4, 1), unit_length=1.0)

    def render(self) -> Any:
        """Draws the scene with as many samples and pixels as fit the time.

        Returns
        -------
        yt.visualization.image_handling.ImageArray
            The picture, of :attr:`resolution`.
        """
        width, height = (int(n) for n in self.scene.camera.resolution)
        self.most, self.full = int(self.source.num_samples), (width, height)
        # Steps below 1/64 cannot be predicted; more than 64 samples per cell are predicted as 64.
        counts = list(range(self.most, 0, -1))
        settings = [(max(1 / 64, 1 / n), self.full) for n in counts]
        scale = 1.0
        while scale > self.smallest:
            scale = max(self.smallest, scale / 1.25)
            settings.append((1.0, (max(1, int(self.full[0] * scale)), max(1, int(self.full[1] * scale)))))
        index, plan = self.session.choose(
            self._camera(),
            self._function(),
            self.full,
            self.seconds,
            settings,
            skipping="none",
            termination=1.0,
        )
        self.samples, self.resolution = counts[min(index, self.most - 1)], settings[index][1]
        self.predicted, self._plan = plan.seconds, plan
        camera = self.scene.camera
        self.source.num_samples, camera.resolution = self.samples, self.resolution
        before, processor_seconds = time.perf_counter(), -time.process_time()
        try:
            picture = self.scene.render()
        finally:
            self.measured = time.perf_counter() - before
            processor_seconds += time.process_time()
            self.source.num_samples, camera.resolution = self.most, self.full
        with contextlib.suppress(ValueError):  # A rejected time has no effect.
            self.session.observe(plan, self.measured, processor_seconds=processor_seconds)
        return picture

    def full_quality(self) -> Any:
        """Draws the scene with its own settings, without a time limit.

        Returns
        -------
        yt.visualization.image_handling.ImageArray
        """
        return self.scene.render()

    @property
    def why(self) -> str:
        """str : Reason for the last picture's settings, in a sentence."""
        return explain(self._plan) if self._plan else "no picture was drawn yet"

    @property
    def history(self) -> History:
        """History : The last pictures."""
        return self.session.history

    def __repr__(self) -> str:
        return (
            f"Holder({type(self.source).__name__} to {self.seconds:.3g} s, {_clocks.both(self.session)}: {self.why})"
        )

    def _repr_html_(self) -> str:
        return self.history._repr_html_()


def hold(
    scene: Any,
    seconds: float,
    *,
    model: ModelLike | None = None,
    smallest: float = 0.25,
    edge: int = 256,
) -> Holder:
    """Renders a yt scene within a time per picture.

    yt takes a whole number of samples in every cell that a ray crosses (``num_samples``), and draws a picture of
    ``camera.resolution``. The number of samples is reduced first; if one sample per cell still takes too long, the
    picture becomes smaller.

    Parameters
    ----------
    scene : yt.visualization.volume_rendering.api.Scene
        A scene with one volume source and a perspective or plane-parallel camera.
    seconds : float
        Target time of a picture, in seconds.
    model : Model, str, os.PathLike or bytes, optional
        As in :class:`entire.Session`. Pictures are timed by the wall clock; if the model's clock
        (``entire.clock`` in its metadata) differs, a warning says that the model's scale is learned from the first
        pictures.
    smallest : float, optional
        Smallest allowed side of the picture, as a share of the full side; positive. Default 0.25.
    edge : int, optional
        Maximum number of cells along an axis of the regular grid from which the field is read for predictions.
        Default 256.

    Returns
    -------
    Holder

    Raises
    ------
    CannotSteer
        For a scene without a volume source, another lens, or a transfer function without opacities.
    ValueError
        For `seconds`, `smallest` or `edge` that are not positive.
    """
    return Holder(scene, seconds, model, smallest, edge)
