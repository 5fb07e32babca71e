# SPDX-License-Identifier: MIT OR Apache-2.0
"""Models by name, sessions with a history, and predictions of many views."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Union

from . import _native
from ._history import History

if TYPE_CHECKING:
    from typing import Literal

    import numpy as np
    import numpy.typing as npt
    from typing_extensions import Self

    Shading = Literal["none", "local", "scatter", "local-scatter"]
    Skipping = Literal["blocks", "none", "distance"]

_FOLDER = Path(__file__).parent / "models"
_REASONS = {
    "fits": "the finest step that is expected to meet the target and whose upper bound is within the "
    "tolerance; if no step has such a bound, the step with the least expected cost of late frames and lost quality, "
    "among those that are expected to meet the target",
    "damped": "the step changes gradually towards that of 'fits', since nothing changed abruptly",
    "held": "the last step is still expected to meet the target and is close to that of 'fits'",
    "finest allowed": "the finest allowed step is expected to meet the target",
    "target unreachable": "even the coarsest allowed step is not expected to meet the target",
    "history": "the step was chosen by the times of recent frames, since the prediction is not trusted here",
    "no information": "there is neither a prediction nor a measured frame yet",
    "off": "steering is switched off",
    "reactive": "the step was chosen by a rule that uses only past frames",
}
# Probe of the adapters' sessions, the same as in vtkEntireSteering: rays along each side of the finest probe for analytic
# models, and the probe's accepted error. The number of rays is low, since each takes about a microsecond after a large
# frame has evicted the probe's data from the caches.
PROBE_SIDE, PROBE_TOLERANCE = 7, 0.3


def models() -> list[str]:
    """Names of the models in the package.

    Returns
    -------
    list of str
        Sorted; each is accepted by :class:`Model` and, if it predicts, by the parameter `model` of functions.
    """
    return sorted(path.stem for path in _FOLDER.glob("*.safetensors"))


@contextlib.contextmanager
def _named(path: Union[str, os.PathLike[str]]) -> Iterator[None]:
    """Context that puts the file's name before the text of a ValueError about the file's content."""
    try:
        yield
    except ValueError as error:
        raise type(error)(f"{os.fspath(path)}: {error}") from None


class CannotSteer(ValueError):
    """A scene that cannot be steered; the text names the reason and the remedy."""


class Model(_native.Model):
    """A model file: a predictor of frame times, an encoder of volumes, or both.

    Parameters
    ----------
    source : str, os.PathLike or bytes
        The name of a shipped model (see :func:`models`), the path of a model file, or the bytes of one.

    Raises
    ------
    ModelError
        For bytes that are not a model file, or for a damaged model file.
    FileNotFoundError
        For a text that is neither a shipped model's name nor a file.

    Examples
    --------
    >>> import entire
    >>> entire.Model("unshaded-selected").predicts
    True
    """

    def __new__(cls, source: Union[str, os.PathLike[str], bytes]) -> Self:
        if isinstance(source, (bytes, bytearray, memoryview)):
            return super().__new__(cls, bytes(source))
        path = Path(source)
        if isinstance(source, str) and source in models():
            path = _FOLDER / f"{source}.safetensors"
        if not path.is_file():
            raise FileNotFoundError(
                f"{os.fspath(source)!r} is neither a file nor a shipped model; shipped are "
                f"{', '.join(models())}"
            )
        with _named(path):
            return super().__new__(cls, path.read_bytes())

    @classmethod
    def machine(cls, shading: Shading = "none") -> Self:
        """Opens the model of this machine that ``entire calibrate`` stored in the user's data folder. It predicts
        seconds of entire's own raycaster, by the clock in ``metadata["entire.clock"]``.

        Parameters
        ----------
        shading : {"none", "local", "scatter", "local-scatter"}, optional
            Shading mode, as in ``--shade``.

        Returns
        -------
        Model

        Raises
        ------
        ValueError
            If `shading` is none of these modes.
        FileNotFoundError
            If the machine was not calibrated for the mode; the text gives the command to do so.
        """
        return cls(_native.machine_file(shading))

    def save(self, path: Union[str, os.PathLike[str]]) -> None:
        """Writes the model file, completely or not at all.

        Parameters
        ----------
        path : str or os.PathLike
        """
        _native.write_whole(path, self.to_bytes())

    def __repr__(self) -> str:
        does = [word for word, has in (("predicts", self.predicts), ("encodes volumes", self.encodes)) if has]
        return f"Model({' and '.join(does)}, {len(self.to_bytes())} bytes)"


ModelLike = Union[Model, str, "os.PathLike[str]", bytes]


def _model(given: ModelLike | None) -> Model | None:
    return given if given is None or isinstance(given, Model) else Model(given)


class Calibrated(NamedTuple):
    """A model that was fitted to timed frames, with its report."""

    #: The model.
    model: Model
    #: Number of frames that the model was fitted to.
    frames: int
    #: Groups of the cross-validation that gave the errors below: "volumes", "transfer functions", "stretches
    #: of time", or "nothing" if there were too few frames.
    held_out: str
    #: Median of |predicted / measured - 1| over held-out frames.
    median_error: float
    #: Root mean square error in seconds over held-out frames, divided by the standard deviation of their times.
    rmse_over_sd: float
    #: Upper bound divided by the prediction: 95 % of frames take no longer than this bound.
    upper_factor: float
    #: Number of scenes of :meth:`Session.record_picture` that the quality law was fitted to; 0 without a law.
    scenes: int = 0


class Session(_native.Session):
    """Predicts and steers one render loop of any renderer.

    For every frame: :meth:`plan`, draw with the plan's step, then :meth:`observe` the time that the frame took. A
    session may be used from any thread; calls from several threads run one after the other.

    Parameters
    ----------
    volume : Volume, optional
        The volume to draw; :meth:`set_volume` replaces it.
    model : Model, str, os.PathLike or bytes, optional
        Predictor, or an argument of :class:`Model`. Without one, an analytic model (unit costs times estimated work)
        adapts to the renderer in the first frames.
    tolerance : float, optional
        Share of the target by which the upper bound of a plan's time may exceed the target. The upper bound is that of
        frames that no other program slows down. Default 0.1.
    miss_rate : float, optional
        Share of frames that may exceed their upper bound while nothing in the scene changes abruptly, above 0 and at
        most 0.5. Default 0.05.
    trust_limit : float, optional
        Value of :attr:`Plan.out_of_range` above which recent frames are used instead of the prediction. Default 2.
    damping : bool, optional
        If true, the step changes only slowly while nothing in the scene changes abruptly. Default True.
    ignore_load : bool, optional
        If true, the picture keeps its quality while other programs slow frames down, and frames exceed the
        target. If the load lasts longer than 32 frames, the slower speed counts as the machine's normal speed
        from then on, and steps are chosen for it. Default False.
    probe_side : int, optional
        Rays along each side of the probe that estimates a frame's work, 1 to 24, for analytic models. Default 11.
    probe_tolerance : float, optional
        Accepted error of the probe, as a share of the frame's time, 0 to 1, for analytic models. Over 0, plans start
        with a probe of 4 rays along each side and refine it, up to `probe_side`, only if the probe's estimated error is
        larger than `probe_tolerance` and could change the plan. While the view has hardly turned since rays were cast,
        their result is reused. Default 0: every plan casts all of its rays, as plans of recorded frames
        (:meth:`record`) always do.

    Raises
    ------
    ValueError
        For an option out of range.
    ModelError
        For a model that does not predict.

    Examples
    --------
    >>> import numpy as np, entire
    >>> volume = entire.Volume(np.random.default_rng(0).integers(0, 255, (32, 32, 32), np.uint8))
    >>> tf = entire.TransferFunction.points([(0, 0), (1, 0.1)])
    >>> session = entire.Session(volume)
    >>> plan = session.plan(entire.Camera.arcball(20, 30, 3), tf, (640, 480), target=0.02)
    >>> session.observe(plan, seconds=0.018)
    'learned'
    """

    def __new__(
        cls,
        volume: _native.Volume | None = None,
        *,
        model: ModelLike | None = None,
        tolerance: float = 0.1,
        miss_rate: float = 0.05,
        trust_limit: float = 2.0,
        damping: bool = True,
        ignore_load: bool = False,
        probe_side: int | None = None,
        probe_tolerance: float = 0.0,
    ) -> Self:
        return super().__new__(
            cls,
            volume,
            model=_model(model),
            tolerance=tolerance,
            miss_rate=miss_rate,
            trust_limit=trust_limit,
            damping=damping,
            ignore_load=ignore_load,
            probe_side=probe_side,
            probe_tolerance=probe_tolerance,
        )

    def record(self, frames: int = 1000, *, model: ModelLike | None = None) -> None:
        """Starts recording planned and observed frames for :meth:`calibrate`. Earlier recorded frames are dropped.

        Not recorded are unusual and cancelled observations, the first frame of the session and of each volume, the first
        frame after the learned state was loaded or dropped, and frames announced by ``mark(first=True)``. To record
        frames that were timed earlier, turn steering off (:meth:`set_enabled`), plan each frame as it was drawn, and
        observe its time.

        Parameters
        ----------
        frames : int, optional
            Number of frames to keep, 8 to 65536: a uniform random sample if more are observed. Default 1000.
        model : Model, str, os.PathLike or bytes, optional
            The model to start from: unit costs that were fitted on another machine or renderer. Default: the
            unit costs of a software renderer.

        Raises
        ------
        ValueError
            If `frames` is outside 8 to 65536.
        ModelError
            For a model that is not an analytic model.
        """
        self.record_from(frames, _model(model))

    def calibrate(self) -> Calibrated:
        """Fits a model of the renderer and machine to the recorded frames (:meth:`record`). Takes a second
        or less for 500 frames. :meth:`set_model` puts it into the session, ``Model.save`` stores it.

        Returns
        -------
        Calibrated

        Raises
        ------
        NotReadyError
            If fewer than 8 frames were recorded.

        Examples
        --------
        >>> session.record()                                                     # doctest: +SKIP
        >>> draw(session, cameras)                                               # doctest: +SKIP
        >>> made = session.calibrate()                                           # doctest: +SKIP
        >>> session.set_model(made.model)                                        # doctest: +SKIP
        """
        data, report = self.calibrate_bytes()
        return Calibrated(Model(data), **report)

    def set_model(self, model: ModelLike) -> None:
        """Replaces the session's model. Observations are dropped; volume, transfer function and limits stay. Recorded
        frames are dropped only if the number of probe rays changes with the model. If the model takes volume features,
        set the volume again.

        Parameters
        ----------
        model : Model, str, os.PathLike or bytes

        Raises
        ------
        ModelError
            For a model without a prediction network.
        """
        self.steer_by(model if isinstance(model, Model) else Model(model))

    @property
    def history(self) -> History:
        """History : The last observed frames, at most 4096, oldest first."""
        return History(self.columns())

    def save(self, path: Union[str, os.PathLike[str]]) -> None:
        """Writes the learned state to a file, completely or not at all.

        Parameters
        ----------
        path : str or os.PathLike

        Raises
        ------
        OSError
            If the file cannot be written; the text names it.
        """
        _native.write_whole(path, self.save_state())

    def load(self, path: Union[str, os.PathLike[str]]) -> None:
        """Loads the learned state from a file of :meth:`save`; on an error nothing changes.

        Parameters
        ----------
        path : str or os.PathLike

        Raises
        ------
        ValueError
            For a file that is not a saved state.
        ModelError
            For a valid state of another model, renderer or clock (:meth:`set_timing_source`).
        """
        with _named(path):
            self.load_state(Path(path).read_bytes())

    def _repr_html_(self) -> str:
        return self.history._repr_html_()


def explain(plan: _native.Plan) -> str:
    """Explains the reason of a plan in a sentence.

    Parameters
    ----------
    plan : Plan

    Returns
    -------
    str
    """
    return _REASONS.get(plan.reason, plan.reason)


def predict(
    volume: _native.Volume | npt.ArrayLike,
    cameras: Sequence[_native.Camera] | npt.ArrayLike,
    tf: _native.TransferFunction,
    size: Sequence[int],
    *,
    model: ModelLike | None = None,
    step: float = 1.0,
    shading: Shading = "none",
    skipping: Skipping = "blocks",
    termination: float = 0.99,
    fov: float = 45.0,
) -> npt.NDArray[np.float32]:
    """Predicts the seconds of many views at once.

    Parameters
    ----------
    volume : Volume or array_like
        The volume to draw, or an array that :class:`Volume` accepts.
    cameras : sequence of Camera, or array_like of shape (n, 3) or (n, 4, 4)
        Cameras, arcball poses (rx and ry in degrees, dz in radii), or world-to-eye matrices.
    tf : TransferFunction
    size : (int, int)
        Width and height of the image in pixels.
    model : Model, str, os.PathLike or bytes, optional
        A model, or an argument of :class:`Model`. A model predicts the seconds of one machine and renderer;
        calibrate for yours. Without a model the seconds are those of a typical software renderer, so only
        ratios between views are meaningful.
    step : float, optional
        Ray step in reference steps (smallest voxel spacings). Default 1.
    shading, skipping, termination
        As in :meth:`Session.plan`.
    fov : float, optional
        Vertical field of view in degrees if `cameras` is an array. Default 45.

    Returns
    -------
    numpy.ndarray
        float32, shape (n,): seconds, bit for bit the same as predictions of single views.

    Examples
    --------
    >>> import numpy as np, entire
    >>> volume = np.zeros((16, 16, 16), np.uint8)
    >>> tf = entire.TransferFunction.points([(0, 0), (1, 0.1)])
    >>> orbit = np.stack([np.zeros(90), np.linspace(0, 356, 90), np.full(90, 2.5)], axis=1)
    >>> entire.predict(volume, orbit, tf, (640, 480)).shape
    (90,)
    """
    what: Any = volume
    given = what if isinstance(what, _native.Volume) else _native.Volume(what)
    return Session(given, model=model).predict_many(
        cameras, tf, size, step=step, shading=shading, skipping=skipping, termination=termination, fov=fov
    )
