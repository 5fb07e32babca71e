# SPDX-License-Identifier: MIT OR Apache-2.0
"""Steering by VTK's events: set before the mapper looks, put back after it drew, learned from how long it took."""
from __future__ import annotations

import contextlib
import logging
import math
import os
import statistics
import time
import weakref
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, Union

from vtkmodules.vtkCommonCore import vtkWeakReference

from .._core import ModelLike, Session, _model, explain
from .._history import History
from .._native import Plan
from . import _mappers, _scene
from ._mappers import CannotSteer
from ._overlay import Overlay

log = logging.getLogger("entire.vtk")

# Rays along each side of the probe that measures frames for linear cost models: between large frames every ray costs about
# a microsecond.
_PROBE_SIDE = 6
# Coarsening of the GPU mapper's step before its image shrinks: any smaller image is blurred by much.
_GPU_STEP_ALONE = 2.1
# Least share of the target that a mapper is given, however much the rest of the frame takes.
_LEAST_SHARE = 0.2
# How many frames the time outside of the mappers is taken from.
_REST_FRAMES = 5
_NAN = math.nan

# Steering by the address of the volume that it holds. The scene's observers keep steerings alive, nothing else does.
_held: weakref.WeakValueDictionary[str, Steering] = weakref.WeakValueDictionary()


class _Weak:
    """A VTK object that is not kept alive."""

    __slots__ = ("_reference",)

    def __init__(self, target: Any = None) -> None:
        self._reference = vtkWeakReference()
        if target is not None:
            self._reference.Set(target)

    def __call__(self) -> Any:
        return self._reference.Get()


class Leaf:
    """One held volume: its mapper, its session and the last frame's read-outs.

    Attributes
    ----------
    session : entire.Session
        What predicts this volume's frames; its ``history`` holds them.
    predicted, measured : float
        Seconds that the mapper was expected to take, and took; NaN where there is none.
    sample_distance : float
        Sample distance along rays that was drawn with, in the unit of the spacing; NaN where VTK chose it.
    image_sample_distance : float
        Pixels between rays along each side of the image; NaN where VTK chose it.
    reason : str
        Why the frame was drawn as it was, in a word or two; "still", "off" or "fallback" where it was not steered.
    status : str
        In words, why the frame was not steered; empty where it was.
    volume_time : float
        Seconds that the last reading of the voxels took.
    """

    def __init__(self, steering: Steering, volume: Any, make_gpu: Callable[[Any], Any]) -> None:
        self._volume = _Weak(volume)
        self._steering = steering
        self._mapper = _Weak()
        self._tags: list[int] = []
        # The smart mapper that another one stands in for.
        self._exchanged: Any = None
        self._make_gpu = make_gpu
        self._gpu = False
        self._forget()
        self.session: Session = steering._session()
        self.volume_time = _NAN
        self._weight = 0.0
        self._reset_readouts()
        self._observe(volume)

    def _reset_readouts(self) -> None:
        self.predicted = self.measured = self.sample_distance = self.image_sample_distance = _NAN
        self.reason, self.status = "", "no frame was drawn yet"

    def _forget(self) -> None:
        self._key: Any = None
        self._grid: Any = None
        self._tf: Any = None
        self._tf_key: Any = None
        self._look: Any = None
        self._camera: Any = None
        self._limits: Any = None
        self._plan: Plan | None = None
        self._own: Any = None
        self._times: Any = None
        self._image = self._shown = _Weak()
        self._placed: Any = None
        self._pixels = self._finest = self._termination = 1.0
        self._shading: Literal["none", "local"] = "none"
        self._wrote = (_NAN, _NAN)
        self._wrote_time = 0
        self._steered = self._ready = self._drawing = False
        self._started = 0.0

    @property
    def volume(self) -> Any:
        """vtkVolume : The volume, or None when it is gone."""
        return self._volume()

    def _observe(self, volume: Any) -> None:
        """Finds the mapper that draws and listens to it; exchanges a smart one."""
        mapper = volume.GetMapper()
        why = _mappers.refusal(mapper)
        if why:
            raise CannotSteer(why)
        if mapper.IsA("vtkSmartVolumeMapper"):
            gpu = self._make_gpu(mapper)
            self._exchanged = mapper
            volume.SetMapper(gpu)
            self._steering._note(
                "vtkSmartVolumeMapper gives Python no access to the mapper inside; a GPU mapper draws in its place until detach()"
            )
            mapper = gpu
        self._mapper = _Weak(mapper)
        self._gpu = _mappers.is_gpu(mapper)
        self._tags = [
            mapper.AddObserver("VolumeMapperRenderStartEvent", self._start),
            mapper.AddObserver("VolumeMapperRenderEndEvent", self._end),
        ]

    def _release(self, give_back: bool = True) -> None:
        mapper = self._mapper()
        if mapper is not None:
            self._restore(mapper)
            for tag in self._tags:
                mapper.RemoveObserver(tag)
        self._tags = []
        self._mapper = _Weak()
        if self._exchanged is not None:
            smart, self._exchanged = self._exchanged, None
            volume = self._volume()
            if give_back and mapper is not None and volume is not None and volume.GetMapper() is mapper:
                # What was set meanwhile holds on.
                _mappers.copy_changed(mapper, smart)
                volume.SetMapper(smart)
        self._grid = self._tf = None

    def _follow(self) -> None:
        """Listens to another mapper where the application has set one."""
        volume = self._volume()
        if volume is None:
            return
        mapper = volume.GetMapper()
        if mapper is not None and mapper is not self._mapper():
            self._release(give_back=False)
            self._forget()
            try:
                self._observe(volume)
            except CannotSteer as refused:
                self._fall_back(str(refused))

    # The fixed-point mapper takes its distances, and the opacities that go with them, before it announces its start.
    def _renderer_start(self) -> None:
        self._ready = False
        self._follow()
        volume, mapper = self._volume(), self._mapper()
        if self._gpu or volume is None or mapper is None or not volume.GetVisibility():
            return
        source = mapper.GetInputAlgorithm()
        if source is not None:
            source.Update()
        self._prepare(mapper)
        self._ready = True

    def _renderer_end(self) -> None:
        if self._steered:
            mapper = self._mapper()
            if mapper is not None:
                self._restore(mapper)

    def _start(self, mapper: Any, _event: str) -> None:
        steering = self._steering
        if not steering._rendering:
            return
        if self._gpu:
            self._prepare(mapper)
            steering._finish()
        elif not self._ready:
            return
        self._ready = False
        self._drawing = True
        if self._steered:
            steering.steered_frames += 1
        elif self.reason == "fallback":
            steering.fallback_frames += 1
        self._started = steering._now()

    def _end(self, mapper: Any, _event: str) -> None:
        if not self._drawing:
            return
        # The GPU mapper waits for the device by itself before it announces its end.
        steering = self._steering
        seconds = steering._now() - self._started
        before = time.perf_counter()
        self._drawing = False
        if self._gpu:
            self._restore(mapper)
        self.measured = seconds
        plan, self._plan = self._plan, None
        if plan is not None:
            window = steering._window()
            cancelled = window is not None and bool(window.GetAbortRender())
            with contextlib.suppress(ValueError):  # A time that is rejected teaches nothing.
                self.session.observe(plan, seconds, cancelled=cancelled)
            # What the frame would have taken at full quality, roughly.
            whole = seconds * plan.step * plan.image_sample_distance**2
            self._weight = whole if self._weight == 0 else 0.7 * self._weight + 0.3 * whole
        steering._mapper_seconds += seconds
        steering._drawn += 1
        steering._last = self
        steering._overhead += time.perf_counter() - before

    def _restore(self, mapper: Any) -> None:
        if self._steered:
            self._steered = False
            if mapper.GetMTime() != self._wrote_time:
                # The application has set it since: only what it left is put back, and read anew.
                self._own.restore(mapper, *self._wrote)
                self._times = None
                return
            self._own.write(mapper, self._wrote[1])
            if self._times is not None:
                self._times = (mapper.GetMTime(), *self._times[1:])

    def _prepare(self, mapper: Any) -> None:
        before = time.perf_counter()
        self._restore(mapper)
        self._plan = None
        try:
            self._choose(mapper)
        except ValueError as error:
            self._fall_back(str(error))
        except Exception as error:  # A frame is never lost for the sake of its prediction.
            self._fall_back(f"{type(error).__name__}: {error}")
        plan = self._plan
        self.predicted = _NAN if plan is None else plan.seconds
        if plan is None:
            self.sample_distance = self.image_sample_distance = _NAN
        self._steering._overhead += time.perf_counter() - before

    def _fall_back(self, why: str) -> None:
        if why != self.status:
            log.warning("not steered: %s", why)
        self._plan = None
        self.reason, self.status = "fallback", why

    def _read_mapper(self, mapper: Any) -> None:
        """Reads what changes seldom: the input, the volume's functions and place, the mapper's own settings."""
        steering, session, volume = self._steering, self.session, self._volume()
        if volume is None:
            raise _scene.Unreadable("the volume is gone")
        shown = _first_volume(volume)
        prop = shown.GetProperty()
        image = _scene.input_of(mapper)
        component = 0 if prop.GetIndependentComponents() else -1
        key = _scene.grid_key(mapper, image, component)
        if key != self._key:
            began = time.perf_counter()
            grid = _scene.Grid(mapper, image, component)
            session.set_volume(grid.volume)
            self._grid, self._key, self._tf_key = grid, key, None
            steering._clean = False
            self.volume_time = time.perf_counter() - began
        grid = self._grid
        tf_key = prop.GetMTime()
        if tf_key != self._tf_key:
            self._tf = _scene.transfer_function(prop, grid.range)
            self._tf_key = tf_key
        look = _scene.look(prop, mapper)
        if look != self._look:
            if self._look is not None:
                session.mark(mode=True)
            self._look = look
            self._shading = "local" if look[0] else "none"
            self._termination = _scene.termination(look, self._gpu)
        own = self._own = _mappers.Settings(mapper)
        # Where VTK adjusts by itself, the image sample distance that it left is that of an earlier frame.
        self._pixels = 1.0 if own.adjust else max(0.1, own.image)
        finest = _mappers.spacing_adjusted(image) if own.lock else own.sample
        self._finest = min(4096.0, max(1 / 64, finest / grid.reference))
        self._image, self._shown = _Weak(image), _Weak(shown)
        self._placed = shown.GetMatrix().GetData()
        self._times = (mapper.GetMTime(), image.GetMTime(), shown.GetMTime())

    def _choose(self, mapper: Any) -> None:
        steering, session = self._steering, self.session
        renderer, window = steering._renderer(), steering._window()
        if renderer is None or window is None:
            raise _scene.Unreadable("the renderer has no window")
        image, shown = self._image(), self._shown()
        # Modification times say whether anything but the camera is another: each read costs most of a frame's overhead.
        if image is None or shown is None or self._times != (mapper.GetMTime(), image.GetMTime(), shown.GetMTime()):
            self._times = None
            self._read_mapper(mapper)
        grid, own = self._grid, self._own
        camera = _scene.camera(renderer, self._placed, grid)
        if self._camera is not None and camera.jumps_from(self._camera):
            session.mark(camera=True)
        self._camera = camera
        finest, pixels = self._finest, self._pixels
        size = renderer.GetSize()
        drawn = size if pixels == 1 else (_side(size[0] / pixels), _side(size[1] / pixels))
        target = steering._target(window, self)
        skipping: Literal["none", "blocks"] = "none" if self._gpu else "blocks"
        still = steering._is_still(window)
        if still or not steering.enabled:
            self.reason = "still" if still else "off"
            self.status = "a still frame, drawn by VTK alone" if still else "steering is off"
            # Learned from where it is known how finely VTK draws it.
            if still or not own.adjust:
                session.set_enabled(False)
                self._plan = session.plan(
                    camera,
                    self._tf,
                    drawn,
                    target,
                    step=finest,
                    shading=self._shading,
                    skipping=skipping,
                    termination=self._termination,
                )
                session.set_enabled(True)
                self.sample_distance, self.image_sample_distance = finest * grid.reference, pixels
            return
        if steering.finest is not None:
            finest = max(1 / 64, steering.finest)
        limits = (finest, steering.coarsest, steering.coarsest_image, pixels)
        if limits != self._limits:
            session.set_limits(finest, max(finest, steering.coarsest))
            coarsest_image = min(64.0, max(1.0, steering.coarsest_image / pixels))
            session.set_max_image_sample_distance(coarsest_image, _GPU_STEP_ALONE if self._gpu else 1.0)
            self._limits = limits
        plan = session.plan(
            camera,
            self._tf,
            drawn,
            target,
            step=finest,
            shading=self._shading,
            skipping=skipping,
            termination=self._termination,
        )
        self._plan = plan
        image_distance = plan.image_sample_distance
        self._wrote = (plan.step * grid.reference, own.image if image_distance == 1 and not own.adjust else pixels * image_distance)
        _mappers.write(mapper, own, *self._wrote)
        self._wrote_time = mapper.GetMTime()
        self._steered = True
        self.sample_distance, self.image_sample_distance = self._wrote
        self.reason, self.status = plan.reason, ""
        self._explained = plan

    @property
    def why(self) -> str:
        """str : Why the last frame was drawn as it was, in a sentence."""
        if self.status:
            return self.status
        return explain(self._explained)


def _side(pixels: float) -> int:
    return min(16384, max(1, math.floor(pixels)))


def _first_volume(volume: Any) -> Any:
    """The volume itself, or the first one of several that one mapper draws together."""
    if not volume.IsA("vtkMultiVolume"):
        return volume
    for port in range(10):
        inner = volume.GetVolume(port)
        if inner is not None:
            return inner
    raise _scene.Unreadable("the vtkMultiVolume holds no volume")


class Steering:
    """Holds volumes of a renderer to a frame time. Made by :func:`hold`, which documents the parameters.

    The scene keeps a steering alive, not the other way round: keep it to read it out or to end it with :meth:`detach`.

    Attributes
    ----------
    seconds : float or None
        Seconds that a whole frame of the window may take; None takes 1 / the window's ``DesiredUpdateRate``.
    enabled : bool
        Whether frames are steered.
    coarsest, finest : float, float or None
        Coarsest and finest sample distance along rays, in smallest voxel spacings; None is the mapper's own.
    coarsest_image : float
        Most pixels between rays along each side of the image.
    leaves : list of Leaf
        The held volumes.
    notes : list of str
        What was done to the scene on attaching.
    frames : int
        Frames of the window in which a held volume was drawn.
    frame_time : float
        Seconds that the window's last frame took.
    overhead : float
        Seconds that prediction and steering themselves took in the last frame, on the wall.
    steered_frames, fallback_frames : int
        Frames of volumes that were steered, and that VTK drew on its own because they could not be predicted.
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
        always: bool | None = None,
        still_rate: float = 1.0,
        clock: str = "wall",
        overlay: bool = False,
        make_gpu: Callable[[Any], Any] = _mappers.gpu_in_place_of,
    ) -> None:
        if seconds is not None and not (math.isfinite(seconds) and seconds > 0):
            raise ValueError(
                f"seconds is {seconds}; it must be finite and positive (1 / 30 for 30 frames per second), or None"
            )
        clocks = {"wall": time.perf_counter, "cpu": time.process_time}
        if clock not in clocks:
            raise ValueError(f"clock is {clock!r}; it must be 'wall' or 'cpu' (processor time of this process)")
        if not 1 / 64 <= coarsest <= 4096:
            raise ValueError(f"coarsest is {coarsest} voxel spacings; it must lie in 1/64 to 4096")
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
            "probe_side": _PROBE_SIDE,
        }
        self._now: Callable[[], float] = clocks[clock]
        self._make_gpu = make_gpu
        self._state: bytes | None = None
        self._still = 0
        self._outside: deque[float] = deque(maxlen=_REST_FRAMES)
        self._rests: deque[float] = deque(maxlen=_REST_FRAMES)
        self._rest = self._outside_time = 0.0
        self.frames = 0
        self._rendering = self._in_frame = False
        self._clean = True
        self._frame_start = self._mapper_seconds = self._overhead = 0.0
        self._drawn = 0
        self._last: Leaf | None = None
        self._props_time = 0
        self._all = volumes is None
        self.notes: list[str] = []
        self.leaves: list[Leaf] = []
        self.frame_time = self.overhead = _NAN
        self.steered_frames = self.fallback_frames = 0
        self.on_frame: Callable[[Steering], None] | None = None
        self._renderer = _Weak(renderer)
        self._window = _Weak()
        self._window_tags: list[int] = []
        self._renderer_tags: list[int] = []
        self._overlay = Overlay(renderer) if overlay else None
        try:
            for volume in _volumes(renderer) if volumes is None else volumes:
                self._add(volume)
        except BaseException:
            self.detach()
            raise
        self._renderer_tags = [
            renderer.AddObserver("StartEvent", self._on_renderer_start, 1.0),
            renderer.AddObserver("EndEvent", self._on_renderer_end),
        ]
        self._follow_window(renderer.GetRenderWindow())

    def _add(self, volume: Any) -> None:
        address = volume.__this__
        earlier = _held.get(address)
        if earlier is not None:
            earlier._drop(volume)
        self.leaves.append(Leaf(self, volume, self._make_gpu))
        _held[address] = self

    def _drop(self, volume: Any) -> None:
        for leaf in [leaf for leaf in self.leaves if leaf.volume is volume]:
            leaf._release()
            self.leaves.remove(leaf)
            _held.pop(volume.__this__, None)
        if not self.leaves:
            self.detach()

    def _note(self, text: str) -> None:
        if text not in self.notes:
            self.notes.append(text)
            log.info("%s", text)

    def _session(self) -> Session:
        session = Session(**self._options)
        if self._state is not None:
            session.load_state(self._state)
        return session

    def detach(self) -> None:
        """Lets go of the scene: mappers are as the application left them, exchanged ones are put back."""
        for address in [a for a, s in _held.items() if s is self]:
            del _held[address]
        for leaf in self.leaves:
            leaf._release()
        self.leaves = []
        self._last = None
        renderer = self._renderer()
        if renderer is not None:
            for tag in self._renderer_tags:
                renderer.RemoveObserver(tag)
        self._renderer_tags = []
        self._follow_window(None)
        self._rendering = False
        if self._overlay is not None:
            self._overlay.remove()
            self._overlay = None

    @contextlib.contextmanager
    def still(self) -> Iterator[None]:
        """Frames drawn inside are VTK's own, pixel for pixel: for screenshots and movies.

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
        """Tells of time that belongs to a frame but passes outside of the window's drawing: encoding the picture, sending it.

        Later frames leave room for the median of the last five.

        Parameters
        ----------
        seconds : float
            Not negative.
        """
        if not (math.isfinite(seconds) and seconds >= 0):
            raise ValueError(f"seconds is {seconds}; it must be finite and not negative")
        self._outside.append(seconds)
        self._outside_time = statistics.median(self._outside)

    def reset(self) -> None:
        """Forgets what was learned."""
        self._state = None
        for leaf in self.leaves:
            leaf._forget()
            leaf.session = self._session()

    def save(self, path: Union[str, os.PathLike[str]]) -> None:
        """Writes what was learned of the volume that was drawn last.

        Parameters
        ----------
        path : str or os.PathLike

        Raises
        ------
        ValueError
            Before the first frame.
        """
        if self._last is None:
            raise ValueError("nothing was learned yet: no frame was drawn")
        self._last.session.save(path)

    def load(self, path: Union[str, os.PathLike[str]]) -> None:
        """Starts from what :meth:`save` wrote, now and whenever learning starts anew.

        Parameters
        ----------
        path : str or os.PathLike

        Raises
        ------
        ValueError
            For a file that is no saved state; then nothing changes.
        """
        state = Path(path).read_bytes()
        Session().load_state(state)
        self._state = state
        for leaf in self.leaves:
            leaf.session.load_state(state)

    @property
    def renderer(self) -> Any:
        """vtkRenderer : The renderer, or None when it is gone."""
        return self._renderer()

    @property
    def _leaf(self) -> Leaf | None:
        return self._last or (self.leaves[0] if self.leaves else None)

    @property
    def predicted(self) -> float:
        """float : Seconds that the mappers were expected to take in the last frame."""
        return math.fsum(leaf.predicted for leaf in self.leaves) if self.leaves else _NAN

    @property
    def measured(self) -> float:
        """float : Seconds that the mappers took in the last frame."""
        return math.fsum(leaf.measured for leaf in self.leaves) if self.leaves else _NAN

    @property
    def sample_distance(self) -> float:
        """float : Sample distance along rays of the volume that was drawn last, in the unit of its spacing."""
        return self._leaf.sample_distance if self._leaf else _NAN

    @property
    def image_sample_distance(self) -> float:
        """float : Pixels between rays along each side of the image, of the volume that was drawn last."""
        return self._leaf.image_sample_distance if self._leaf else _NAN

    @property
    def reason(self) -> str:
        """str : Why the last frame was drawn as it was, in a word or two."""
        return self._leaf.reason if self._leaf else "detached"

    @property
    def status(self) -> str:
        """str : In words, why the last frame was not steered; empty where it was."""
        return self._leaf.status if self._leaf else "attached to nothing"

    @property
    def why(self) -> str:
        """str : Why the last frame was drawn as it was, in a sentence."""
        return self._leaf.why if self._leaf else "attached to nothing"

    @property
    def history(self) -> History:
        """History : The last frames of the volume that was drawn last; the others' are at ``leaves``."""
        return self._leaf.session.history if self._leaf else Session().history

    def __repr__(self) -> str:
        if not self.leaves:
            return "Steering(attached to nothing)"
        target = "the window's rate" if self.seconds is None else f"{1e3 * self.seconds:.1f} ms"
        frame = "" if math.isnan(self.frame_time) else f", last frame {1e3 * self.frame_time:.1f} ms"
        notes = "".join(f"; {note}" for note in self.notes)
        return f"Steering({len(self.leaves)} volume(s) to {target}{frame}: {self.why}{notes})"

    def _repr_html_(self) -> str:
        return self.history._repr_html_()

    # Events. None of them may raise: VTK would go on with half a frame.

    def _follow_window(self, window: Any) -> None:
        before = self._window()
        if window is before and (window is not None or not self._window_tags):
            return
        if before is not None:
            for tag in self._window_tags:
                before.RemoveObserver(tag)
        self._window_tags = []
        self._in_frame = False
        self._window = _Weak(window)
        if window is not None:
            self._window_tags = [
                window.AddObserver("StartEvent", self._on_window_start, 1.0),
                window.AddObserver("EndEvent", self._on_window_end),
            ]

    def _on_window_start(self, _window: Any, _event: str) -> None:
        self._in_frame = True
        self._clean = True
        self._mapper_seconds = self._overhead = 0.0
        self._drawn = 0
        self._frame_start = self._now()

    def _on_window_end(self, _window: Any, _event: str) -> None:
        if not self._in_frame:
            return
        seconds = self._now() - self._frame_start
        before = time.perf_counter()
        self._in_frame = False
        if self._drawn == 0:
            return
        # The first frame holds what is done once.
        if self.frames > 0 and self._clean:
            self._rests.append(max(0.0, seconds - self._mapper_seconds))
            self._rest = sorted(self._rests)[len(self._rests) // 2]
        self.frames += 1
        self.frame_time = seconds
        self.overhead = self._overhead + time.perf_counter() - before
        if self.on_frame is not None:
            self.on_frame(self)

    def _on_renderer_start(self, renderer: Any, _event: str) -> None:
        if renderer.GetSelector() is not None:
            # A pass that picks, not one that shows.
            return
        before = time.perf_counter()
        inside = self._overhead
        self._follow_window(renderer.GetRenderWindow())
        if self._all:
            self._follow_volumes(renderer)
        self._rendering = True
        for leaf in self.leaves:
            leaf._renderer_start()
        if self._overlay is not None:
            window = self._window()
            self._overlay.show(self, window is not None and not self._is_still(window))
        # What leaves counted by themselves is part of this.
        self._overhead = inside + time.perf_counter() - before

    def _on_renderer_end(self, _renderer: Any, _event: str) -> None:
        before = time.perf_counter()
        self._rendering = False
        for leaf in self.leaves:
            leaf._renderer_end()
        self._overhead += time.perf_counter() - before

    def _follow_volumes(self, renderer: Any) -> None:
        changed = renderer.GetViewProps().GetMTime()
        if changed == self._props_time:
            return
        self._props_time = changed
        there = {volume.__this__: volume for volume in _volumes(renderer)}
        for leaf in [leaf for leaf in self.leaves if leaf.volume is None or leaf.volume.__this__ not in there]:
            volume = leaf.volume
            leaf._release()
            self.leaves.remove(leaf)
            if volume is not None:
                _held.pop(volume.__this__, None)
        known = {leaf.volume.__this__ for leaf in self.leaves}
        for address, volume in there.items():
            if address not in known and address not in _held:
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

    def _finish(self) -> None:
        window = self._window()
        if window is not None:
            window.WaitForCompletion()

    def _target(self, window: Any, leaf: Leaf) -> float:
        wanted = self.seconds if self.seconds is not None else 1.0 / max(window.GetDesiredUpdateRate(), 1e-4)
        left = max(wanted - self._rest - self._outside_time, _LEAST_SHARE * wanted)
        n = len(self.leaves)
        if n > 1:
            total = sum(other._weight for other in self.leaves)
            # Shares by what each would take at full quality, so that all are coarsened alike.
            left *= leaf._weight / total if leaf._weight and total else 1.0 / n
        return left


def _volumes(renderer: Any) -> list[Any]:
    """The volumes of a renderer, those inside assemblies included."""
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
    always: bool | None = None,
    still_rate: float = 1.0,
    clock: str = "wall",
    overlay: bool = False,
    make_gpu: Callable[[Any], Any] = _mappers.gpu_in_place_of,
) -> Steering:
    """Holds volumes of a renderer to a frame time, from the next frame on.

    Before each frame the mapper's sample distance (and, where that is not enough, its image sample distance) is set to what
    is expected to take the time asked for; after the frame it is put back. Still frames are VTK's, pixel for pixel. No frame
    is drawn finer than the mapper's own settings, unless `finest` says so.

    Parameters
    ----------
    renderer : vtkRenderer
    volume : vtkVolume or sequence of vtkVolume, optional
        What is held; several volumes share the time so that all are coarsened alike. Default: every volume of the renderer,
        those that are added later included. A volume that is held already changes hands.
    seconds : float, optional
        Seconds that a whole frame of the window may take, everything else that it draws included. Default: 1 / the window's
        ``DesiredUpdateRate``.
    model : Model, str, os.PathLike or bytes, optional
        Predictor of the first frames, from :func:`calibrate` or ``entire train``. Without one the first three frames or so
        settle it.
    coarsest, finest : float, optional
        Coarsest and finest sample distance along rays, in smallest voxel spacings. Default 8, and the mapper's own.
    coarsest_image : float, optional
        Most pixels between rays along each side of the image, 1 to 100; 1 leaves the image alone. Default 4.
    tolerance, miss_rate : float, optional
        At most this share of frames may be more than so much over the target. Default 0.25 and 0.02.
    always : bool, optional
        Whether frames are steered whatever rate the window asks for. Default: only where the window has no interactor. With
        one, frames for which it asks for less than `still_rate` frames per second are still ones.
    still_rate : float, optional
        See `always`. Default 1.
    clock : {"wall", "cpu"}, optional
        What measures: the wall, or the processor time of this process (for renderers on the CPU of a shared machine).
    overlay : bool, optional
        Whether a line in the corner shows expected and measured time and the step; never on still frames. Default False.
    make_gpu : callable, optional
        Makes the GPU mapper that takes the place of a given vtkSmartVolumeMapper.

    Returns
    -------
    Steering

    Raises
    ------
    CannotSteer
        Where a mapper cannot be steered; the text says why and what to do.
    ValueError
        For an option out of range, or a renderer without volumes.

    Examples
    --------
    >>> steering = entire.vtk.hold(renderer, volume, seconds=1 / 30)           # doctest: +SKIP
    """
    if renderer is None or not renderer.IsA("vtkRenderer"):
        raise ValueError("renderer must be a vtkRenderer; windows hold theirs in GetRenderers()")
    volumes: Sequence[Any] | None
    if volume is None:
        volumes = None
        if not _volumes(renderer):
            raise ValueError("the renderer has no volume; add one with AddVolume() before hold(), or pass it")
    elif hasattr(volume, "IsA"):
        volumes = [volume]
    else:
        volumes = list(volume)
    for each in volumes or ():
        if not each.IsA("vtkVolume"):
            raise ValueError(f"{each.GetClassName()} is no volume; pass a vtkVolume, not its mapper or data")
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
        always=always,
        still_rate=still_rate,
        clock=clock,
        overlay=overlay,
        make_gpu=make_gpu,
    )
