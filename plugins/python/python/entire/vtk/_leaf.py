# SPDX-License-Identifier: MIT OR Apache-2.0
"""One held volume: read, planned for, set, timed and put back."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from time import perf_counter
from typing import TYPE_CHECKING, Any, Literal

from vtkmodules.vtkCommonCore import vtkWeakReference

from .._core import Session, explain
from .._native import Held, PassShare, Plan
from . import _mappers, _scene
from ._mappers import CannotSteer

if TYPE_CHECKING:
    from ._steering import Steering

log = logging.getLogger("entire.vtk")

# Quality laws of the mappers' pictures (Session.set_quality) for models that state none, as
# vtkEntireSteering has it.
_GPU_QUALITY = (8.5, 1.22, 0.78, 0.15)
_FIXED_POINT_QUALITY = (5.9, 0.97, 1.54, 0.33)
_NAN = math.nan
# Attribute in which a volume keeps Python's wrapper of its mapper.
_KEPT = "_entire_mapper"
_NONE_DUE: tuple[Plan | None, float, bool] = (None, _NAN, False)


def weak(target: Any = None) -> Callable[[], Any]:
    """Weak reference to a VTK object: returns it, or None once it is gone."""
    reference = vtkWeakReference()
    if target is not None:
        reference.Set(target)
    get: Callable[[], Any] = reference.Get
    return get


class Leaf:
    """One held volume: its mapper, its session and the last frame's read-outs.

    Attributes
    ----------
    measured : float
        Seconds that the mapper took; NaN before the first frame.
    share_time : float
        Seconds that its last pass was given of the target: all volumes that are held in a window share its frame's
        time, also for two eyes and in several renderers.
    sample_distance : float
        Sample distance along rays that was drawn with, in the unit of the spacing; NaN where VTK chose it.
    image_sample_distance : float
        Pixels between rays along each side of the image; NaN where VTK chose it.
    status : str
        In words, why the frame was not steered; empty where it was.
    volume_time : float
        Seconds that the last reading of the voxels took.
    """

    # Every page of memory that a frame touches costs as much as hundreds of instructions, because drawing has emptied
    # the caches: so the code of a frame is flat, and reads no more of VTK than it must.
    __slots__ = (
        "_class", "_drawing", "_due", "_ended", "_exchanged", "_explained", "_finest", "_frame_mapper",
        "_frame_volume", "_gpu", "_grid", "_held", "_image", "_image_time", "_key", "_limits", "_look",
        "_coarsening", "_make_gpu", "_mapper", "_mapper_time", "_nodes", "_own", "_pass", "_pixels", "_plain", "_plan", "_ready",
        "_reason", "_seen", "_session", "_shading", "_shown", "_shown_time", "_stale", "_started", "_steered",
        "_steering", "_tags", "_termination", "_tf", "_tf_key", "_volume", "_volume_tag", "_wrote",
        "address", "image_sample_distance", "measured", "sample_distance", "share_time", "status", "volume_time",
    )  # fmt: skip

    def __init__(self, steering: Steering, volume: Any, make_gpu: Callable[[Any], Any]) -> None:
        self._volume = weak(volume)
        # Key of the held volume, valid also when it is gone.
        self.address: str = volume.__this__
        self._steering = steering
        self._mapper = weak()
        self._tags: list[int] = []
        self._volume_tag = 0
        # The smart mapper that was replaced.
        self._exchanged: Any = None
        self._make_gpu = make_gpu
        self._gpu = False
        # Class of the mapper, to which the learned state belongs.
        self._class = ""
        self._session: Session
        self._forget()
        self.volume_time = _NAN
        # Share of the window's frame, whose passes draw it once or several times: two eyes.
        self._pass = PassShare()
        self._reset_readouts()
        self._observe(volume)
        self._volume_tag = volume.AddObserver("ModifiedEvent", self._on_modified)

    def _reset_readouts(self) -> None:
        self.measured = self.sample_distance = self.image_sample_distance = self.share_time = _NAN
        self._seen: Plan | None = None
        self._reason, self.status = "", "no frame was drawn yet"

    def _forget(self) -> None:
        self._key: Any = None
        self._grid: Any = None
        self._tf: Any = None
        self._tf_key: Any = None
        # Inputs of the session's transfer function.
        self._nodes: Any = None
        self._look: Any = None
        self._limits: Any = None
        self._held: Any = None
        self._plan: Plan | None = None
        self._explained: Plan | None = None
        # The last frame's plan with its seconds, which the session observes with the next frame.
        self._due: tuple[Plan, float, bool] | None = None
        self._own: Any = None
        # The first of several volumes that one mapper draws, else None.
        self._shown: Callable[[], Any] | None = None
        # The input that was read last, and modification times; -1 before.
        self._image: Any = None
        self._mapper_time = self._image_time = self._shown_time = -1
        # True if VTK's own rules are off, so that only the distances are set.
        self._plain = True
        self._pixels = self._finest = self._termination = self._coarsening = 1.0
        self._shading: Literal["none", "local"] = "none"
        self._wrote = (_NAN, _NAN)
        self._steered = self._ready = self._drawing = self._ended = self._stale = False
        self._started = 0.0
        # References that are held only while a frame is drawn.
        self._frame_mapper: Any = None
        self._frame_volume: Any = None

    @property
    def session(self) -> Session:
        """entire.Session : The predictor of this volume's frames; its ``history`` holds them."""
        self._settle()
        return self._session

    def _restart(self, session: Session) -> None:
        """Continues with a new session."""
        self._after_frame(self._restore_whole())
        self._forget()
        self._session = session

    def _settle(self) -> None:
        """Gives the session the last frame's time."""
        due, self._due = self._due, None
        if due is not None:
            plan, seconds, cancelled = due
            try:
                self._session.observe(plan, seconds, cancelled=cancelled)
            except ValueError:
                pass  # A time that is rejected teaches nothing.

    @property
    def predicted(self) -> float:
        """float : Expected seconds of the mapper in the last frame; NaN without a prediction."""
        return _NAN if self._seen is None else self._seen.seconds

    @property
    def reason(self) -> str:
        """str : Reason of the last frame's settings, in a word or two; "still", "off" or "fallback" if it was not
        steered."""
        return self._reason if self._explained is None else self._explained.reason

    @property
    def volume(self) -> Any:
        """vtkVolume : The volume, or None when it is gone."""
        return self._volume()

    def _observe(self, volume: Any) -> None:
        """Finds the mapper that draws and observes it; exchanges a smart one."""
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
        self._mapper = weak(mapper)
        # Python's wrapper of the mapper lives as long as the volume, since VTK otherwise makes and destroys one for
        # each event. The volume keeps the mapper itself alive anyway.
        volume.__dict__[_KEPT] = mapper
        self._gpu = _mappers.is_gpu(mapper)
        name = mapper.GetClassName()
        if name != self._class:
            # State learned from mappers of another class does not hold for this one.
            self._class, self._session = name, self._steering._session(name)
        self._tags = [
            mapper.AddObserver("VolumeMapperRenderStartEvent", self._start),
            mapper.AddObserver("VolumeMapperRenderEndEvent", self._end),
        ]

    def _on_modified(self, _volume: Any, _event: str) -> None:
        # The mapper may be another one.
        self._stale = True

    def _leave(self) -> None:
        """Releases the volume and its mapper."""
        volume = self._volume()
        if volume is not None and self._volume_tag:
            volume.RemoveObserver(self._volume_tag)
        self._volume_tag = 0
        self._settle()
        self._release()

    def _release(self, give_back: bool = True) -> None:
        mapper = self._mapper()
        later = self._restore_whole()
        if mapper is not None:
            for tag in self._tags:
                mapper.RemoveObserver(tag)
        self._tags = []
        self._mapper = weak()
        drawn = self._volume()
        if drawn is not None:
            drawn.__dict__.pop(_KEPT, None)
        if self._exchanged is not None:
            smart, self._exchanged = self._exchanged, None
            volume, told = self._volume(), self._steering._given_back

            def put_back() -> None:
                if volume.GetMapper() is mapper:
                    # Settings made meanwhile stay.
                    _mappers.copy_changed(mapper, smart)
                    volume.SetMapper(smart)
                    if told is not None:
                        told(mapper, smart)

            if give_back and mapper is not None and volume is not None:
                later.append(put_back)
        self._after_frame(later)
        self._grid = self._tf = self._nodes = self._image = None

    def _follow(self) -> None:
        """Observes another mapper if the application has set one."""
        self._stale = False
        volume = self._volume()
        if volume is None:
            return
        mapper = volume.GetMapper()
        if mapper is not None and mapper is not self._mapper():
            self._settle()
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
        volume, mapper = self._volume(), self._mapper()
        if volume is None or mapper is None or not volume.GetVisibility():
            return
        source = mapper.GetInputAlgorithm()
        if source is not None:
            # The time of the application's pipeline is not ours.
            before = perf_counter()
            source.Update()
            self._steering._overhead -= perf_counter() - before
        self._prepare(mapper)
        self._ready = True

    def _start(self, mapper: Any, _event: str) -> None:
        steering = self._steering
        if not steering._rendering:
            return
        if self._gpu:
            before = perf_counter()
            if self._ended:
                # Drawn more than once in a frame, in passes.
                self._finish()
            self._prepare(mapper)
            steering._overhead += perf_counter() - before
            # Earlier work on the device is not this mapper's.
            steering._frame_window.WaitForCompletion()
        elif not self._ready:
            return
        self._ready = False
        if self._steered:
            steering.steered_frames += 1
        elif self._reason == "fallback":
            steering.fallback_frames += 1
        self._drawing = True
        self._started = steering._now()

    def _end(self, _mapper: Any, _event: str) -> None:
        # The rest is done at the renderer's end.
        if self._drawing:
            if self._gpu:
                # The device has finished earlier work: the time is the mapper's own.
                self._steering._frame_window.WaitForCompletion()
            self.measured = self._steering._now() - self._started
            self._drawing = False
            self._ended = True

    def _finish(self) -> None:
        """Restores the mapper's settings, and counts its time."""
        steered = self._steered
        if steered:
            self._restore()
        self._frame_mapper = self._frame_volume = None
        plan, self._plan = self._plan, None
        self._drawing = False
        if not self._ended:
            return
        self._ended = False
        steering, seconds = self._steering, self.measured
        if plan is not None:
            # Observed with the next frame's plan, or when a read-out is requested.
            self._due = (plan, seconds, steering._frame_window.GetAbortRender() != 0)
        if steered and steering._shared.drawing:
            # A volume that is not steered is part of the rest, for which the others make room.
            steering._shared.budget.drew(self._pass, seconds, seconds * self._coarsening)
        steering._measured_now += seconds
        steering._predicted_now += self.predicted
        steering._drawn += 1
        steering._last = self

    def _restore(self) -> None:
        mapper, own = self._frame_mapper, self._own
        self._steered = False
        if mapper.GetMTime() != self._mapper_time:
            # The application has changed something since: only its unchanged settings are restored, and the rest is
            # read again.
            own.restore(mapper, *self._wrote)
            self._mapper_time = -1
            return
        if self._plain:
            mapper.SetSampleDistance(own.sample)
            if self._wrote[1] != own.image:
                mapper.SetImageSampleDistance(own.image)
        else:
            own.write(mapper, self._wrote[1])
        self._mapper_time = mapper.GetMTime()

    def _restore_whole(self) -> list[Callable[[], None]]:
        """Restores the mapper's settings, whether it draws or not; returns what is to be repeated afterwards."""
        mapper = self._mapper()
        if mapper is None or not self._steered:
            return []
        own, wrote = self._own, self._wrote
        self._restore()
        # The fixed-point mapper ends its drawing by writing the sample distance with which it began.
        return [] if self._gpu else [lambda: own.restore(mapper, *wrote)]

    def _after_frame(self, calls: list[Callable[[], None]]) -> None:
        """Calls when the renderer's frame ends; at once outside of frames. A mapper that draws would undo its settings,
        and might not survive to be exchanged."""
        renderer = self._steering._renderer()
        if calls and self._steering._rendering and renderer is not None:
            at_end(renderer, calls)
        else:
            for call in calls:
                call()

    def _several(self, together: Any) -> int:
        """A number that grows with every change of several volumes in one mapper."""
        shown = None if self._shown is None else self._shown()
        return -1 if shown is None else int(together.GetMTime() + shown.GetMTime())

    def _prepare(self, mapper: Any) -> None:
        if self._steered:
            self._restore()
        self._plan = self._explained = None
        self._coarsening = 1.0
        try:
            self._choose(mapper)
        except ValueError as error:
            self._fall_back(str(error))
        except Exception as error:  # A frame is never lost for the sake of its prediction.
            self._fall_back(f"{type(error).__name__}: {error}")
        plan = self._seen = self._plan
        if plan is None:
            self.sample_distance = self.image_sample_distance = _NAN

    def _fall_back(self, why: str) -> None:
        if why != self.status:
            log.warning("not steered: %s", why)
        self._plan = self._explained = None
        self._reason, self.status = "fallback", why

    def _read_mapper(self, mapper: Any) -> None:
        """Reads data that seldom change: the input, the volume's functions and place, the mapper's own settings."""
        self._mapper_time = -1
        self._settle()
        steering, session, volume = self._steering, self._session, self._frame_volume
        shown = first_volume(volume)
        prop = shown.GetProperty()
        image = _scene.input_of(mapper)
        component = 0 if prop.GetIndependentComponents() else -1
        key = _scene.grid_key(mapper, image, component)
        if key != self._key:
            began = perf_counter()
            grid = _scene.Grid(mapper, image, component)
            session.set_volume(grid.volume)
            self._grid, self._key, self._tf_key, self._nodes = grid, key, None, None
            steering._shared.usual = False
            self.volume_time = perf_counter() - began
        grid = self._grid
        tf_key = _scene.transfer_key(prop)
        if tf_key != self._tf_key:
            # Functions change for many reasons; only different nodes matter to the session.
            nodes = _scene.transfer_nodes(prop, grid.range)
            if nodes != self._nodes:
                self._tf = _scene.transfer_function(nodes)
                session.set_transfer_function(self._tf)
                self._nodes = nodes
            self._tf_key = tf_key
        look = _scene.look(prop, mapper)
        if look != self._look:
            if self._look is not None:
                session.mark(mode=True)
            self._look = look
            self._shading = "local" if look[0] else "none"
            self._termination = _scene.termination(look, self._gpu)
        own = self._own = _mappers.Settings(mapper)
        # If VTK adjusts by itself, its image sample distance is that of an earlier frame.
        self._pixels = 1.0 if own.adjust else max(0.1, own.image)
        placed = _scene.elements(shown.GetMatrix())
        finest = _mappers.full_quality(own, image, placed, self._gpu)
        self._finest = min(4096.0, max(1 / 64, finest / grid.reference))
        self._held = Held(
            grid.volume,
            placed,
            grid.direction,
            grid.center,
            step=self._finest,
            shading=self._shading,
            skipping="none" if self._gpu else "blocks",
            termination=self._termination,
        )
        self._plain = not (own.adjust or own.lock)
        self._shown = None if shown is volume else weak(shown)
        self._image, self._image_time = image, image.GetMTime()
        self._shown_time = volume.GetMTime() if shown is volume else self._several(volume)
        self._mapper_time = mapper.GetMTime()

    def _choose(self, mapper: Any) -> None:
        steering = self._steering
        renderer, window = steering._frame_renderer, steering._frame_window
        volume = self._volume()
        if renderer is None or window is None or volume is None:
            raise _scene.Unreadable("the renderer has no window, or the volume is gone")
        self._frame_mapper, self._frame_volume = mapper, volume
        # Modification times show changes other than the camera's; the volume's includes that of its functions. A
        # producer that replaces its output changes none of them.
        if (
            mapper.GetMTime() != self._mapper_time
            or (volume.GetMTime() if self._shown is None else self._several(volume)) != self._shown_time
            or _scene.input_of(mapper) is not self._image
            or self._image.GetMTime() != self._image_time
        ):
            self._read_mapper(mapper)
        own, pixels, reference = self._own, self._pixels, self._grid.reference
        size = drawn = renderer.GetSize()
        if pixels != 1:
            drawn = (_side(size[0] / pixels), _side(size[1] / pixels))
        steered = steering._steers
        if not steered:
            still = steering._still_frame
            self._reason = "still" if still else "off"
            self.status = "a still frame, drawn by VTK alone" if still else "steering is off"
            if not still and own.adjust:
                # The frame is observed if the resolution of VTK's drawing is known.
                return
        step = None
        if steered:
            if steering.finest is not None:
                step = max(1 / 64, steering.finest)
            # VTK's GPU mapper draws smaller images only in viewports at the window's origin; elsewhere they stay empty.
            placed = self._gpu and renderer.GetOrigin() != (0, 0)
            coarsest_image = pixels if placed else steering.coarsest_image
            limits = (step, self._finest, steering.coarsest, coarsest_image, pixels)
            if limits != self._limits:
                self._set_limits(self._finest if step is None else step, coarsest_image)
                self._limits = limits
        camera = renderer.GetActiveCamera()
        matrix = camera.GetViewTransformMatrix()
        # Python's wrappers of both are kept for the next frame.
        steering._camera = camera, matrix
        due, self._due = self._due, None
        before, seconds, cancelled = _NONE_DUE if due is None else due
        target = self.share_time = steering._shared.budget.share(self._pass, steering._target)
        plan, coarse, image_distance = self._session.steer(
            self._held,
            _scene.elements(matrix),
            _scene.vertical_angle(camera, size) if camera.GetUseHorizontalViewAngle() else camera.GetViewAngle(),
            camera.GetParallelScale() if camera.GetParallelProjection() else None,
            drawn,
            target,
            step,
            steered,
            before,
            seconds,
            cancelled,
        )
        self._plan = plan
        self._coarsening = coarse / (self._finest if step is None else step) * image_distance * image_distance
        if not steered:
            self.sample_distance, self.image_sample_distance = self._finest * reference, pixels
            return
        sample = coarse * reference
        image = own.image if image_distance == 1 and not own.adjust else pixels * image_distance
        if self._plain:
            mapper.SetSampleDistance(sample)
            if image != own.image:
                mapper.SetImageSampleDistance(image)
        else:
            _mappers.write(mapper, own, sample, image)
        self._wrote = (sample, image)
        self._steered = True
        self._mapper_time = mapper.GetMTime()
        self.sample_distance, self.image_sample_distance = sample, image
        self._reason = self.status = ""
        self._explained = plan

    def _set_limits(self, finest: float, coarsest_image: float) -> None:
        self._settle()
        steering, session = self._steering, self._session
        session.set_limits(finest, max(finest, steering.coarsest))
        session.set_max_image_sample_distance(min(64.0, max(1.0, coarsest_image / self._pixels)))
        # The quality law that the model states of this mapper's pictures, if it was calibrated with some.
        session.set_quality(None)
        if session.quality is None:
            session.set_quality(*(_GPU_QUALITY if self._gpu else _FIXED_POINT_QUALITY))

    @property
    def why(self) -> str:
        """str : Reason of the last frame's settings, in a sentence."""
        if self._explained is None:
            return self.status
        return explain(self._explained)


def at_end(renderer: Any, calls: list[Callable[[], None]]) -> None:
    """Calls once when the renderer's frame ends."""
    tags: list[int] = []

    def ended(_renderer: Any, _event: str) -> None:
        renderer.RemoveObserver(tags[0])
        for call in calls:
            call()

    tags.append(renderer.AddObserver("EndEvent", ended))


def _side(pixels: float) -> int:
    return min(16384, max(1, math.floor(pixels)))


def first_volume(volume: Any) -> Any:
    """The volume itself, or the first of several that one mapper draws together."""
    if not volume.IsA("vtkMultiVolume"):
        return volume
    for port in range(10):
        inner = volume.GetVolume(port)
        if inner is not None:
            return inner
    raise _scene.Unreadable("the vtkMultiVolume holds no volume")
