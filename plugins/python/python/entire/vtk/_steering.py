# SPDX-License-Identifier: MIT OR Apache-2.0
"""Steering by VTK's events: settings are made before the mapper reads them, restored after it drew, and its time is
observed."""

from __future__ import annotations

import contextlib
import logging
import math
import numbers
import os
import statistics
import weakref
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any, Union

from .. import _clocks
from .._core import PROBE_SIDE, PROBE_TOLERANCE, CannotSteer, ModelLike, Session, _model, _named
from .._history import History
from .._native import ModelError, write_whole
from . import _mappers
from ._leaf import Leaf, refusal
from ._overlay import Overlay
from ._weak import weak
from ._window import frame_of, is_picking

log = logging.getLogger("entire.vtk")

# Smallest target of the window's frame, as a share of `Steering.seconds`: the time outside of the window's drawing is
# subtracted only down to this share.
_LEAST_SHARE = 0.2
# Number of recent times spent outside of the window's drawing; their median is the expected time.
_OUTSIDE_TIMES = 5
# Number of still frames off screen, without any steered one, after which a warning names `always`.
_STILL_FRAMES = 10
_NAN = math.nan

# Steerings by the address of their volume. Only the scene's observers keep steerings alive.
_held: weakref.WeakValueDictionary[str, Steering] = weakref.WeakValueDictionary()
# Steerings that hold all volumes of their renderer, also those that are added later.
_whole: weakref.WeakSet[Steering] = weakref.WeakSet()


def _holder(volume: Any) -> Steering | None:
    """Returns the steering that holds a volume, or None. Compares the address and the volume itself, since a new volume
    may have the address of a deleted one."""
    held = _held.get(volume.__this__)
    return held if held is not None and any(leaf.volume is volume for leaf in held.leaves) else None


class Steering:
    """Holds volumes of a renderer to a frame time. Made by :func:`hold`, which documents the parameters.

    The scene keeps a steering alive, and a steering does not keep the scene alive. Keep the object only to read its
    values or to end it with :meth:`detach`.

    Attributes
    ----------
    seconds : float or None
        Target time of a whole frame of the window, in seconds; None means 1 / the window's
        ``DesiredUpdateRate``.
    enabled : bool
        True if frames are steered.
    coarsest, finest : float, float or None
        Coarsest and finest sample distance along rays, in smallest voxel spacings; None means the mapper's own.
    coarsest_image : float
        Maximum number of pixels between rays along each side of the image.
    leaves : list of Leaf
        The held volumes.
    notes : list of str
        Changes of the scene, such as exchanged mappers, and other messages.
    frames : int
        Number of frames of the window in which a held volume was drawn.
    frame_time : float
        Seconds that the window's last frame took, by the clock of the frames.
    overhead : float
        Wall seconds that prediction and steering took in the last frame.
    steered_frames, fallback_frames : int
        Number of drawings of volumes that were steered, and number of those that VTK drew without steering because they
        could not be predicted.
    """

    def __init__(
        self,
        renderer: Any,
        volumes: Sequence[Any] | None,
        seconds: float | None,
        *,
        model: ModelLike | None = None,
        coarsest: float = 8.0,
        finest: float | None = None,
        coarsest_image: float = 4.0,
        tolerance: float = 0.25,
        miss_rate: float = 0.02,
        ignore_load: bool = False,
        always: bool | None = None,
        still_rate: float = 1.0,
        clock: str = "wall",
        overlay: bool = False,
        make_gpu: Callable[[Any], Any] = _mappers.gpu_in_place_of,
    ) -> None:
        if seconds is not None and not (math.isfinite(seconds) and seconds > 0):
            raise ValueError(
                f"seconds is {seconds}; it must be finite and positive (1 / 30 for 30 frames per second), "
                f"or None"
            )
        now = _clocks.timer(clock)
        if not 1 / 64 <= coarsest <= 4096:
            raise ValueError(f"coarsest is {coarsest} voxel spacings; it must lie in 1/64 to 4096")
        if finest is not None and not 1 / 64 <= finest <= 4096:
            raise ValueError(
                f"finest is {finest} voxel spacings; it must lie in 1/64 to 4096, or be None for the mapper's own"
            )
        if not still_rate >= 0:
            raise ValueError(f"still_rate is {still_rate}; it must not be negative (frames per second)")
        if not 1 <= coarsest_image <= 100:
            raise ValueError(f"coarsest_image is {coarsest_image} pixels; it must lie in 1 to 100")
        self.seconds = seconds
        self.enabled = True
        self.coarsest, self.finest, self.coarsest_image = coarsest, finest, coarsest_image
        self.always, self.still_rate = always, still_rate
        self._options: dict[str, Any] = {
            "model": _model(model),
            "tolerance": tolerance,
            "miss_rate": miss_rate,
            "ignore_load": ignore_load,
            "probe_side": PROBE_SIDE,
            "probe_tolerance": PROBE_TOLERANCE,
        }
        self._clock, self._now = clock, now
        # A session without a volume, so that the warning about clocks comes once, before any volume is attached.
        unbound = self._new_session("")
        self._model_clock, self._clocks = unbound.model_clock, _clocks.both(unbound)
        _clocks.warn(unbound, f", as does entire.vtk.calibrate(..., clock={clock!r})")
        self._make_gpu = make_gpu
        self._state: bytes | None = None
        self._still = 0
        self._outside: deque[float] = deque(maxlen=_OUTSIDE_TIMES)
        self._outside_time = 0.0
        self.frames = 0
        self._rendering = self._in_frame = False
        # References to VTK objects, kept only while a frame is drawn.
        self._frame_window: Any = None
        self._frame_renderer: Any = None
        # The camera of the last frame and its matrix, which have no references to the scene.
        self._camera: Any = None
        # Target in seconds of the current frame, and flags: the frame is a still frame, the frame is steered.
        self._target = _NAN
        self._still_frame = self._steers = False
        self._overhead = 0.0
        self._drawn = 0
        # Seconds of the mappers in the current frame and in the last one.
        self._measured_now = self._predicted_now = 0.0
        self._measured = self._predicted = _NAN
        # Called with a GPU mapper and the smart mapper that replaces it when steering ends.
        self._given_back: Callable[[Any, Any], None] | None = None
        self._last: Leaf | None = None
        # History and learned state of the volume that was drawn last, once it is released.
        self._past: tuple[History, bytes | None] = unbound.history, None
        self._props_time = 0
        self._all = volumes is None
        self.notes: list[str] = []
        self.leaves: list[Leaf] = []
        self.frame_time = self.overhead = _NAN
        self.steered_frames = self.fallback_frames = 0
        self.on_frame: Callable[[Steering], None] | None = None
        self._renderer = weak(renderer)
        self._window = weak()
        self._shared = frame_of(None, clock)
        self._window_tags: list[int] = []
        self._renderer_tags: list[int] = []
        self._overlay = Overlay(renderer) if overlay else None
        try:
            wanted = _volumes(renderer) if volumes is None else list(volumes)
            # All volumes are checked before any is taken from another steering, which continues if a volume is refused.
            for volume in wanted:
                why = refusal(volume, wanted)
                if why:
                    raise CannotSteer(why)
            for volume in wanted:
                self._add(volume)
        except BaseException:
            self.detach()
            raise
        self._renderer_tags = [
            renderer.AddObserver("StartEvent", self._on_renderer_start, 1.0),
            renderer.AddObserver("EndEvent", self._on_renderer_end),
        ]
        self._follow_window(renderer.GetRenderWindow())
        if self._all:
            # An earlier steering would take the volumes that are added later.
            for earlier in [each for each in _whole if each.renderer is renderer]:
                earlier.detach()
            _whole.add(self)

    def _add(self, volume: Any) -> None:
        earlier = _holder(volume)
        if earlier is not None:
            earlier._drop(volume)
        self.leaves.append(Leaf(self, volume, self._make_gpu))
        _held[volume.__this__] = self

    def _drop(self, volume: Any) -> None:
        for leaf in [leaf for leaf in self.leaves if leaf.volume is volume]:
            self._release(leaf)
        if not self.leaves:
            self.detach()

    def _release(self, leaf: Leaf) -> None:
        if self._last is leaf:
            self._keep()
        leaf._leave()
        self.leaves.remove(leaf)
        if _held.get(leaf.address) is self:
            del _held[leaf.address]

    def _keep(self) -> None:
        """Keeps the history and the learned state of the last drawn volume, which is released."""
        if self._last is not None:
            session, self._last = self._last.session, None
            self._past = session.history, session.save_state()

    def _note(self, text: str) -> None:
        if text not in self.notes:
            self.notes.append(text)
            log.info("%s", text)

    def _new_session(self, renderer: str) -> Session:
        session = Session(**self._options)
        session.set_timing_source(renderer, self._clock)
        return session

    def _session(self, renderer: str) -> Session:
        """Makes a session for frames of a mapper class, with the state from :meth:`load` if it belongs to the class."""
        session = self._new_session(renderer)
        if self._state is not None:
            try:
                session.load_state(self._state)
            except ModelError as refused:
                # The state belongs to another mapper class, model or clock.
                self._note(f"load(): {refused}")
        return session

    def detach(self) -> None:
        """Releases the scene: restores the application's settings of mappers, and exchanged mappers. :attr:`history`
        and :meth:`save` still give the last drawn volume's frames and state."""
        self._keep()
        _whole.discard(self)
        for address in [a for a, s in _held.items() if s is self]:
            del _held[address]
        for leaf in self.leaves:
            leaf._leave()
        self.leaves = []
        renderer = self._renderer()
        if renderer is not None:
            for tag in self._renderer_tags:
                renderer.RemoveObserver(tag)
        self._renderer_tags = []
        self._follow_window(None)
        self._rendering = False
        self._frame_window = self._frame_renderer = self._camera = None
        if self._overlay is not None:
            self._overlay.remove()
            self._overlay = None

    @contextlib.contextmanager
    def still(self) -> Iterator[None]:
        """Context in which frames have the same pixels as without steering, for screenshots and movies.

        Examples
        --------
        >>> with steering.still():                                           # doctest: +SKIP
        ...     window.Render()
        """
        self._still += 1
        try:
            yield
        finally:
            self._still -= 1

    def also(self, seconds: float) -> None:
        """Adds time that belongs to a frame but is spent outside of the window's drawing, such as encoding and sending
        the picture.

        The median of the last five times is subtracted from the target of later frames.

        Parameters
        ----------
        seconds : float
            Time in seconds, not negative.
        """
        if not (math.isfinite(seconds) and seconds >= 0):
            raise ValueError(f"seconds is {seconds}; it must be finite and not negative")
        self._outside.append(seconds)
        self._outside_time = statistics.median(self._outside)

    @property
    def outside_time(self) -> float:
        """float : Seconds of a frame outside of the window's drawing: the median of the last five times of
        :meth:`also`; 0 without any."""
        return self._outside_time

    def reset(self) -> None:
        """Discards the learned state, and a state from :meth:`load`."""
        self._state = None
        self._past = Session().history, None
        for leaf in self.leaves:
            leaf._restart(self._session(leaf._class))

    def save(self, path: Union[str, os.PathLike[str]]) -> None:
        """Writes the learned state of the last drawn volume to a file.

        Parameters
        ----------
        path : str or os.PathLike

        Raises
        ------
        ValueError
            Before the first frame.
        """
        state = self._last.session.save_state() if self._last else self._past[1]
        if state is None:
            raise ValueError("nothing was learned yet: no frame was drawn")
        write_whole(path, state)

    def load(self, path: Union[str, os.PathLike[str]]) -> None:
        """Starts from a file of :meth:`save`: now, and whenever a volume gets a new session, until :meth:`reset`.

        A state is valid only for the same model, class of mapper and clock; volumes with other mappers continue without
        it.

        Parameters
        ----------
        path : str or os.PathLike

        Raises
        ------
        ValueError
            For a file that is not a saved state; nothing changes then.
        ModelError
            For a valid state that belongs to none of the held volumes' mappers; nothing changes then.
        """
        state = Path(path).read_bytes()
        with _named(path):
            if not self.leaves:
                # Checks only that the bytes are a state. When volumes are added, it is checked that the state belongs
                # to them.
                with contextlib.suppress(ModelError):
                    self._new_session("").load_state(state)
            refused: list[ModelError] = []
            for leaf in self.leaves:
                try:
                    leaf.session.load_state(state)
                except ModelError as error:
                    refused.append(error)
            if refused and len(refused) == len(self.leaves):
                raise refused[-1]
        self._state = state

    @property
    def renderer(self) -> Any:
        """vtkRenderer or None : The renderer; None once it is deleted."""
        return self._renderer()

    @property
    def clock(self) -> str:
        """str : The clock that times the frames, "wall" or "cpu"."""
        return self._clock

    @property
    def model_clock(self) -> str | None:
        """str or None : The clock whose seconds the model predicts; None if its file states none, and without a model.
        If it differs from :attr:`clock`, the model's scale is learned from the first frames."""
        return self._model_clock

    @property
    def _leaf(self) -> Leaf | None:
        return self._last or (self.leaves[0] if self.leaves else None)

    @property
    def predicted(self) -> float:
        """float : Expected seconds of the mappers in the last frame."""
        return self._predicted

    @property
    def measured(self) -> float:
        """float : Measured seconds of the mappers in the last frame."""
        return self._measured

    @property
    def sample_distance(self) -> float:
        """float : Sample distance along rays of the last drawn volume, in the unit of its spacing."""
        return self._leaf.sample_distance if self._leaf else _NAN

    @property
    def image_sample_distance(self) -> float:
        """float : Pixels between rays along each side of the image, of the last drawn volume."""
        return self._leaf.image_sample_distance if self._leaf else _NAN

    @property
    def reason(self) -> str:
        """str : Reason for the last frame's settings, in a word or two."""
        return self._leaf.reason if self._leaf else "detached"

    @property
    def status(self) -> str:
        """str : Reason why the last frame was not steered; empty if it was."""
        return self._leaf.status if self._leaf else "attached to nothing"

    @property
    def why(self) -> str:
        """str : Reason for the last frame's settings, in a sentence."""
        return self._leaf.why if self._leaf else "attached to nothing"

    @property
    def history(self) -> History:
        """History : The last frames of the volume that was drawn last; ``leaves`` have the frames of the others."""
        return self._last.session.history if self._last else self._past[0]

    def __repr__(self) -> str:
        if not self.leaves:
            return "Steering(attached to nothing)"
        target = "the window's rate" if self.seconds is None else f"{1e3 * self.seconds:.1f} ms"
        frame = "" if math.isnan(self.frame_time) else f", last frame {1e3 * self.frame_time:.1f} ms"
        notes = "".join(f"; {note}" for note in self.notes)
        return f"Steering({len(self.leaves)} volume(s) to {target}, {self._clocks}{frame}: {self.why}{notes})"

    def _repr_html_(self) -> str:
        return self.history._repr_html_()

    # Event handlers. None of them may raise an exception, since VTK would continue in the middle of a frame.

    def _follow_window(self, window: Any) -> None:
        before = self._window()
        if window is before and (window is not None or not self._window_tags):
            return
        if before is not None:
            for tag in self._window_tags:
                before.RemoveObserver(tag)
        self._window_tags = []
        if self._in_frame:
            # Lets the window's other steerings begin a new frame.
            self._shared.drawing = False
        self._in_frame = False
        self._window = weak(window)
        self._shared.steerings.discard(self)
        self._shared = frame_of(window, self._clock)
        self._shared.steerings.add(self)
        if window is not None:
            self._window_tags = [
                window.AddObserver("StartEvent", self._on_window_start, 1.0),
                window.AddObserver("EndEvent", self._on_window_end),
            ]

    def _on_window_start(self, window: Any, _event: str) -> None:
        if self._renderer() is None:
            # Otherwise the window would keep the steering of a deleted renderer, and its voxels, alive.
            self.detach()
            return
        self._in_frame = not is_picking(window)
        if not self._in_frame:
            return
        self._frame_window = window
        self._overhead = 0.0
        self._drawn = 0
        self._measured_now = self._predicted_now = 0.0
        self._shared.begin(self._now())

    def _on_window_end(self, window: Any, _event: str) -> None:
        self._frame_window = None
        if not self._in_frame:
            return
        seconds = self._now() - self._shared.start
        before = perf_counter()
        self._in_frame = False
        self._shared.end(seconds)
        if self._drawn == 0:
            return
        self._measured, self._predicted = self._measured_now, self._predicted_now
        self.frames += 1
        if self.frames == _STILL_FRAMES and self._still_frame and not self._still and self.steered_frames == 0:
            self._warn_of_still_frames(window)
        self.frame_time = seconds
        self.overhead = self._overhead + perf_counter() - before
        if self.on_frame is not None:
            self.on_frame(self)

    def _warn_of_still_frames(self, window: Any) -> None:
        if self.always is None and window.GetOffScreenRendering():
            text = (
                f"none of {_STILL_FRAMES} frames was steered: without interaction, every frame of the off-screen "
                f"window is a still frame; hold(..., always=True) steers every frame"
            )
            self.notes.append(text)
            log.warning("%s", text)

    def _on_renderer_start(self, renderer: Any, _event: str) -> None:
        before = perf_counter()
        window = renderer.GetRenderWindow()
        if window is not None and not self._in_frame and is_picking(window):
            return
        if window is not self._frame_window:
            self._follow_window(window)
            self._frame_window = window
        self._frame_renderer = renderer
        if self._all:
            self._follow_volumes(renderer)
        else:
            for leaf in [leaf for leaf in self.leaves if leaf.volume is None]:
                self._release(leaf)
        self._rendering = True
        still = self._still_frame = window is not None and self._is_still(window)
        self._steers = self.enabled and not still
        wanted = self.seconds
        if wanted is None:
            wanted = 1.0 / max(1.0 if window is None else window.GetDesiredUpdateRate(), 1e-4)
        left, least = wanted - self._outside_time, _LEAST_SHARE * wanted
        self._target = left if left > least else least
        for leaf in self.leaves:
            if leaf._stale:
                leaf._follow()
            if not leaf._gpu:
                leaf._renderer_start()
        if self._overlay is not None:
            self._overlay.show(self, window is not None and not still)
        self._overhead += perf_counter() - before

    def _on_renderer_end(self, _renderer: Any, _event: str) -> None:
        if not self._rendering:
            return
        before = perf_counter()
        self._rendering = False
        for leaf in self.leaves:
            leaf._finish()
        self._frame_renderer = None
        if not self._in_frame:
            # The renderer was drawn without its window.
            self._frame_window = None
        self._overhead += perf_counter() - before

    def _follow_volumes(self, renderer: Any) -> None:
        changed = renderer.GetViewProps().GetMTime()
        if changed == self._props_time:
            return
        self._props_time = changed
        there = {volume.__this__: volume for volume in _volumes(renderer)}
        for leaf in [
            leaf for leaf in self.leaves if leaf.volume is None or leaf.volume.__this__ not in there
        ]:
            self._release(leaf)
        known = {leaf.volume.__this__ for leaf in self.leaves}
        for address, volume in there.items():
            if address not in known and _holder(volume) is None:
                try:
                    self._add(volume)
                except CannotSteer as refused:
                    self._note(str(refused))

    def _is_still(self, window: Any) -> bool:
        if self._still:
            return True
        always = self.always
        if always is None:
            always = window.GetInteractor() is None
        return not always and window.GetDesiredUpdateRate() < self.still_rate


def _check_renderer(renderer: Any) -> None:
    if not hasattr(renderer, "IsA") or not renderer.IsA("vtkRenderer"):
        raise ValueError("renderer must be a vtkRenderer; a window's renderers are in GetRenderers()")


def _volumes(renderer: Any) -> list[Any]:
    """The volumes of a renderer, including those inside assemblies."""
    found = renderer.GetVolumes()
    return [found.GetItemAsObject(i) for i in range(found.GetNumberOfItems())]


def hold(
    renderer: Any,
    volume: Any = None,
    seconds: float | None = None,
    *,
    model: ModelLike | None = None,
    coarsest: float = 8.0,
    finest: float | None = None,
    coarsest_image: float = 4.0,
    tolerance: float = 0.25,
    miss_rate: float = 0.02,
    ignore_load: bool = False,
    always: bool | None = None,
    still_rate: float = 1.0,
    clock: str = "wall",
    overlay: bool = False,
    make_gpu: Callable[[Any], Any] = _mappers.gpu_in_place_of,
) -> Steering:
    """Holds volumes of a renderer to a frame time, from the next frame on.

    Before each frame, the mapper's sample distance and image sample distance are set so that the frame is expected to
    meet the target; after the frame they are restored. VTK draws still frames with the same pixels as without
    steering. No frame is drawn finer than with the mapper's own settings, except with `finest`.

    Parameters
    ----------
    renderer : vtkRenderer
    volume : vtkVolume or sequence of vtkVolume, optional
        The volumes to hold; several share the frame time and are coarsened equally. Default: all volumes of
        the renderer, including those that are added later; an earlier steering of all volumes of the renderer
        ends. A volume that another steering holds is taken over.
    seconds : float, optional
        Target time of a whole frame of the window, including everything else that it draws. Default: 1
        / the window's ``DesiredUpdateRate``.
    model : Model, str, os.PathLike or bytes, optional
        Predictor of the first frames, from :func:`calibrate` or ``entire calibrate --data``. Without one, steering
        learns from about three frames. If the model's clock (``entire.clock`` in its metadata) differs, a warning
        says that the model's scale is learned from the first frames.
    coarsest, finest : float, optional
        Coarsest and finest sample distance along rays, in smallest voxel spacings. Default 8, and the
        mapper's own.
    coarsest_image : float, optional
        Maximum number of pixels between rays along each side of the image, 1 to 100; 1 keeps the full image size.
        Default 4.
    tolerance, miss_rate : float, optional
        A frame is missed if its time exceeds the target by more than `tolerance` times the target. `miss_rate` is the
        share of frames that may be missed. Default 0.25 and 0.02.
    ignore_load : bool, optional
        True to keep the picture's quality while other programs slow frames down; frames then exceed the target. If
        the load lasts longer than 32 frames, the slower speed counts as the machine's normal speed from then on, and
        steps are chosen for it. Default False.
    always : bool, optional
        True to steer every frame. False to steer only frames for which the window's ``DesiredUpdateRate`` is at
        least `still_rate`; the others are still frames. Default: True if the window has no interactor.
    still_rate : float, optional
        Rate in frames per second, see `always`. Default 1.
    clock : {"wall", "cpu"}, optional
        Clock of frame times: wall time, or processor time of this process (for renderers on the CPU of a shared
        machine).
    overlay : bool, optional
        True to show three lines in the corner of the picture, with expected and measured time, step and reason;
        never in still frames. Default False.
    make_gpu : callable, optional
        Function of a vtkSmartVolumeMapper that makes the GPU mapper to replace it.

    Returns
    -------
    Steering

    Raises
    ------
    CannotSteer
        If a mapper cannot be steered; the text gives the reason and the remedy.
    ValueError
        For an option out of range, or a renderer without volumes.

    Examples
    --------
    >>> steering = entire.vtk.hold(renderer, volume, seconds=1 / 30)           # doctest: +SKIP
    """
    _check_renderer(renderer)
    there = _volumes(renderer)
    volumes: Sequence[Any] | None
    if volume is None:
        volumes = None
        if not there:
            raise ValueError("the renderer has no volume; add one with AddVolume() before hold()")
    elif isinstance(volume, numbers.Real):
        raise ValueError(f"volume is {volume}; pass a frame time as seconds={volume}")
    else:
        # Removes duplicates.
        volumes = [volume] if hasattr(volume, "IsA") else list(dict.fromkeys(volume))
        if not volumes:
            raise ValueError("volume is an empty list; pass volumes, or None for all volumes of the renderer")
    for each in volumes or ():
        if not hasattr(each, "IsA") or not each.IsA("vtkVolume"):
            kind = each.GetClassName() if hasattr(each, "GetClassName") else repr(each)
            raise ValueError(f"{kind} is not a volume; pass a vtkVolume, not its mapper or data")
        if each not in there:
            raise ValueError("a volume is not in this renderer; add it with AddVolume(), or pass its own renderer")
    return Steering(
        renderer,
        volumes,
        seconds,
        model=model,
        coarsest=coarsest,
        finest=finest,
        coarsest_image=coarsest_image,
        tolerance=tolerance,
        miss_rate=miss_rate,
        ignore_load=ignore_load,
        always=always,
        still_rate=still_rate,
        clock=clock,
        overlay=overlay,
        make_gpu=make_gpu,
    )
