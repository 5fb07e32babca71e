# SPDX-License-Identifier: MIT OR Apache-2.0
"""One held volume: read, planned for, set, timed and put back."""

from __future__ import annotations

import contextlib
import logging
import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

from vtkmodules.vtkCommonCore import vtkWeakReference

from .._core import Session, explain
from .._native import Plan
from . import _mappers, _scene
from ._mappers import CannotSteer

if TYPE_CHECKING:
    from ._steering import Steering

log = logging.getLogger("entire.vtk")

# Coarsening of the GPU mapper's step before its image shrinks: any smaller image is blurred by much.
_GPU_STEP_ALONE = 2.1
_NAN = math.nan


class Weak:
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
        Why the frame was drawn as it was, in a word or two; "still", "off" or "fallback" where it was not
        steered.
    status : str
        In words, why the frame was not steered; empty where it was.
    volume_time : float
        Seconds that the last reading of the voxels took.
    """

    def __init__(self, steering: Steering, volume: Any, make_gpu: Callable[[Any], Any]) -> None:
        self._volume = Weak(volume)
        self._steering = steering
        self._mapper = Weak()
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
        self._image = self._shown = Weak()
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
                "vtkSmartVolumeMapper gives Python no access to the mapper inside; a GPU mapper draws in "
                "its place until detach()"
            )
            mapper = gpu
        self._mapper = Weak(mapper)
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
        self._mapper = Weak()
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

    # The fixed-point mapper takes its distances, and the opacities that go with them, before it announces its
    # start.
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
        """Reads what changes seldom: the input, the volume's functions and place, the mapper's own
        settings."""
        steering, session, volume = self._steering, self.session, self._volume()
        if volume is None:
            raise _scene.Unreadable("the volume is gone")
        shown = first_volume(volume)
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
        self._image, self._shown = Weak(image), Weak(shown)
        self._placed = shown.GetMatrix().GetData()
        self._times = (mapper.GetMTime(), image.GetMTime(), shown.GetMTime())

    def _choose(self, mapper: Any) -> None:
        steering, session = self._steering, self.session
        renderer, window = steering._renderer(), steering._window()
        if renderer is None or window is None:
            raise _scene.Unreadable("the renderer has no window")
        image, shown = self._image(), self._shown()
        # Modification times say whether anything but the camera is another: each read costs most of a frame's
        # overhead.
        if (
            image is None
            or shown is None
            or self._times != (mapper.GetMTime(), image.GetMTime(), shown.GetMTime())
        ):
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
        self._wrote = (
            plan.step * grid.reference,
            own.image if image_distance == 1 and not own.adjust else pixels * image_distance,
        )
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


def first_volume(volume: Any) -> Any:
    """The volume itself, or the first one of several that one mapper draws together."""
    if not volume.IsA("vtkMultiVolume"):
        return volume
    for port in range(10):
        inner = volume.GetVolume(port)
        if inner is not None:
            return inner
    raise _scene.Unreadable("the vtkMultiVolume holds no volume")
