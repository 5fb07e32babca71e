# SPDX-License-Identifier: MIT OR Apache-2.0
"""One held volume: reads it, plans its frames, writes and restores the mapper's settings, and times the mapper."""

from __future__ import annotations

import logging
import math
import weakref
from collections.abc import Callable, Iterable
from time import perf_counter, process_time
from typing import TYPE_CHECKING, Any, Literal

from .._core import CannotSteer, Session, explain
from .._native import Held, PassShare, Plan
from . import _mappers, _scene
from ._weak import weak

if TYPE_CHECKING:
    from ._steering import Steering

log = logging.getLogger("entire.vtk")

_NAN = math.nan
# Desired update rate, in frames per second, below which a mapper draws still frames at full quality even if its
# automatic adjustment is on.
_FULL_QUALITY_RATE = 0.01
# Attribute in which a volume keeps Python's wrapper of its mapper.
_KEPT = "_entire_mapper"
_NONE_DUE: tuple[Plan | None, float, float, bool] = (None, _NAN, _NAN, False)
# Leaves that observe their volume's mapper.
_observing: weakref.WeakSet[Leaf] = weakref.WeakSet()


class Leaf:
    """One held volume: its mapper, its session and the values of its last frame.

    Attributes
    ----------
    measured : float
        Seconds that the mapper took; NaN before the first frame.
    share_time : float
        The last pass's share of the target, in seconds. All held volumes of a window share its frame time, also if the
        window has two eyes or several renderers.
    sample_distance : float
        Sample distance along rays, in the unit of the spacing; NaN if it is unknown.
    image_sample_distance : float
        Pixels between rays along each side of the image; NaN if it is unknown.
    status : str
        Reason why the last frame was not steered; empty if it was steered.
    volume_time : float
        Wall seconds that the last reading of the voxels took.
    """

    # Drawing evicts data and code from the caches, after which each access to a page of memory takes as long as
    # hundreds of instructions. So the code that runs in every frame has few calls and reads as little of VTK as
    # possible.
    __slots__ = (
        "_class", "_drawing", "_due", "_ended", "_exchanged", "_explained", "_finest", "_frame_mapper",
        "_frame_volume", "_gpu", "_grid", "_held", "_image", "_image_time", "_key", "_limits", "_look",
        "_coarsening", "_make_gpu", "_mapper", "_mapper_time", "_nodes", "_own", "_pass", "_pixels", "_plain", "_plan",
        "_processor_seconds", "_ready", "_reason", "_refused", "_seen", "_session", "_shading", "_shown", "_shown_time", "_stale", "_started",
        "_steered", "_steering", "_tags", "_termination", "_tf", "_tf_key", "_volume", "_volume_tag", "_wrote",
        "address", "image_sample_distance", "measured", "sample_distance", "share_time", "status", "volume_time",
        "__weakref__",
    )  # fmt: skip

    def __init__(self, steering: Steering, volume: Any, make_gpu: Callable[[Any], Any]) -> None:
        self._volume = weak(volume)
        # Key of the held volume, which stays valid when the volume is deleted.
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
        # True if the volume changed since its mapper was compared with the observed one.
        self._stale = False
        self._forget()
        self.volume_time = _NAN
        # State of the volume's share of the window's frame. A frame may draw the volume several times (two eyes).
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
        # The key of an input that cannot be used, and the reason.
        self._refused: tuple[Any, str] | None = None
        self._grid: Any = None
        self._tf: Any = None
        self._tf_key: Any = None
        # Nodes of the session's transfer function.
        self._nodes: Any = None
        self._look: Any = None
        self._limits: Any = None
        self._held: Any = None
        self._plan: Plan | None = None
        self._explained: Plan | None = None
        # The last frame's plan, measured seconds, processor seconds and abort flag, which the session observes with the
        # next frame.
        self._due: tuple[Plan, float, float, bool] | None = None
        self._own: Any = None
        # The first of several volumes that one mapper draws; None if the mapper draws a single volume.
        self._shown: Callable[[], Any] | None = None
        # The input that was read last, and the MTimes of mapper, input and volume at that time; -1 if nothing was read.
        self._image: Any = None
        self._mapper_time = self._image_time = self._shown_time = -1
        # True if the mapper's automatic adjustment and lock are off, so that only the distances must be set.
        self._plain = True
        self._pixels = self._finest = self._termination = self._coarsening = 1.0
        self._shading: Literal["none", "local"] = "none"
        self._wrote = (_NAN, _NAN)
        self._steered = self._ready = self._drawing = self._ended = False
        self._started = 0.0
        # Processor seconds of the process in the frame; NaN if the mapper draws on a graphics device.
        self._processor_seconds = _NAN
        # References to VTK objects, kept only while a frame is drawn.
        self._frame_mapper: Any = None
        self._frame_volume: Any = None

    @property
    def session(self) -> Session:
        """entire.Session : Session that plans this volume's frames; its ``history`` has the last ones."""
        self._settle()
        return self._session

    def _restart(self, session: Session) -> None:
        """Continues with a new session."""
        self._after_frame(self._restore_whole())
        self._forget()
        self._session = session

    def _settle(self) -> None:
        """Makes the session observe the last frame's time, if it has not done so yet."""
        due, self._due = self._due, None
        if due is not None:
            plan, seconds, processor_seconds, cancelled = due
            try:
                self._session.observe(plan, seconds, cancelled=cancelled, processor_seconds=processor_seconds)
            except ValueError:
                pass  # A rejected time has no effect.

    @property
    def predicted(self) -> float:
        """float : Expected seconds of the mapper in the last frame; NaN without a prediction."""
        return _NAN if self._seen is None else self._seen.seconds

    @property
    def reason(self) -> str:
        """str : Reason for the last frame's settings, in a word or two; "still", "off" or "fallback" if it was not
        steered."""
        return self._reason if self._explained is None else self._explained.reason

    @property
    def volume(self) -> Any:
        """vtkVolume or None : The volume; None once it is deleted."""
        return self._volume()

    def _observe(self, volume: Any) -> None:
        """Adds observers to the volume's mapper, after a smart mapper was exchanged for a GPU mapper."""
        mapper = volume.GetMapper()
        why = refusal(volume)
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
        # Keeps Python's wrapper of the mapper alive as long as the volume, since VTK otherwise makes and destroys a
        # wrapper for each event. The volume keeps the mapper itself alive anyway.
        volume.__dict__[_KEPT] = mapper
        self._gpu = _mappers.is_gpu(mapper)
        name = mapper.GetClassName()
        if name != self._class:
            # A state that was learned from a mapper of another class is not valid for this mapper.
            self._class, self._session = name, self._steering._session(name)
        self._tags = [
            mapper.AddObserver("VolumeMapperRenderStartEvent", self._start),
            mapper.AddObserver("VolumeMapperRenderEndEvent", self._end),
        ]
        _observing.add(self)

    def _on_modified(self, _volume: Any, _event: str) -> None:
        # The application may have set another mapper; the next frame checks this.
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
        _observing.discard(self)
        drawn = self._volume()
        if drawn is not None:
            drawn.__dict__.pop(_KEPT, None)
        if self._exchanged is not None:
            smart, self._exchanged = self._exchanged, None
            volume, told = self._volume(), self._steering._given_back

            def put_back() -> None:
                if volume.GetMapper() is mapper:
                    # The smart mapper gets the settings that the application changed meanwhile.
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

    # Plans the frame of a fixed-point mapper. Before its start event, such a mapper reads its distances and computes
    # the opacities for them.
    def _renderer_start(self) -> None:
        self._ready = False
        volume, mapper = self._volume(), self._mapper()
        if volume is None or mapper is None or not volume.GetVisibility():
            return
        source = mapper.GetInputAlgorithm()
        if source is not None:
            # The time of the application's pipeline is not part of the overhead.
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
                # The frame draws the volume in several passes; this ends the previous pass.
                self._finish()
            self._prepare(mapper)
            steering._overhead += perf_counter() - before
            # Waits for the device, so that earlier work does not count as this mapper's time.
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
        self._processor_seconds = _NAN if self._gpu else -process_time()

    def _end(self, _mapper: Any, _event: str) -> None:
        # Only measures the time; _finish() restores the settings and reports the time at the renderer's end.
        if self._drawing:
            if self._gpu:
                # Waits for the device to finish the mapper's work.
                self._steering._frame_window.WaitForCompletion()
            self.measured = self._steering._now() - self._started
            if not self._gpu:
                self._processor_seconds += process_time()
            self._drawing = False
            self._ended = True

    def _finish(self) -> None:
        """Restores the mapper's settings, and adds its time to the frame."""
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
            # The session observes this time with the next frame's plan, or when `session` is accessed.
            aborted = steering._frame_window.GetAbortRender() != 0
            self._due = (plan, seconds, self._processor_seconds, aborted)
        if steered and steering._shared.drawing:
            # The time of a volume that is not steered counts as time outside of the passes, which reduces the shares of
            # the steered volumes.
            steering._shared.budget.drew(self._pass, seconds, seconds * self._coarsening)
        steering._measured_now += seconds
        steering._predicted_now += self.predicted
        steering._drawn += 1
        steering._last = self

    def _restore(self) -> None:
        mapper, own = self._frame_mapper, self._own
        self._steered = False
        if mapper.GetMTime() != self._mapper_time:
            # The application changed the mapper during the frame. Settings that it changed are kept, and the mapper is
            # read again in the next frame.
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
        """Restores the mapper's settings, also while it draws. Returns calls that restore them again, to be made when
        the frame ends."""
        mapper = self._mapper()
        if mapper is None or not self._steered:
            return []
        own, wrote = self._own, self._wrote
        self._restore()
        # When a fixed-point mapper has drawn, it overwrites its sample distance with the one from the start of its
        # drawing.
        return [] if self._gpu else [lambda: own.restore(mapper, *wrote)]

    def _after_frame(self, calls: list[Callable[[], None]]) -> None:
        """Makes the calls when the renderer's frame ends, or at once outside of frames. A mapper that is drawing would
        overwrite the restored settings, and must not be exchanged."""
        renderer = self._steering._renderer()
        if calls and self._steering._rendering and renderer is not None:
            at_end(renderer, calls)
        else:
            for call in calls:
                call()

    def _several(self, together: Any) -> int:
        """Returns a number that grows with every change of a vtkMultiVolume or its first volume; -1 if that volume was
        deleted."""
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
        except Exception as error:  # The frame is drawn even if its prediction fails.
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
        """Reads data that seldom change: input, functions and matrix of the volume, the mapper's own settings."""
        self._mapper_time = -1
        self._settle()
        steering, session, volume = self._steering, self._session, self._frame_volume
        shown = first_volume(volume)
        prop = shown.GetProperty()
        image = _scene.input_of(mapper)
        component = 0 if prop.GetIndependentComponents() else -1
        key = _scene.grid_key(mapper, image, component)
        if key != self._key:
            if self._refused is not None and self._refused[0] == key:
                raise _scene.Unreadable(self._refused[1])
            began = perf_counter()
            try:
                grid = _scene.Grid(mapper, image, component)
                session.set_volume(grid.volume)
            except ValueError as error:
                self._refused = key, str(error)
                raise
            self._grid, self._key, self._tf_key, self._nodes = grid, key, None, None
            steering._shared.usual = False
            self.volume_time = perf_counter() - began
        grid = self._grid
        tf_key = _scene.transfer_key(prop)
        if tf_key != self._tf_key:
            # The session gets the transfer function only if its nodes differ.
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
        # With AutoAdjustSampleDistances, the mapper's image sample distance is that of an earlier frame.
        self._pixels = 1.0 if own.adjust else max(0.1, own.image)
        # A fixed-point mapper is planned before the renderer draws its props. An assembly changes the volume's MTime
        # whenever it draws, so that the volume is read again in the next frame, also if only the assembly was moved.
        renderer = steering._frame_renderer
        placed = _scene.elements(shown.GetMatrix() if self._gpu else _scene.drawn_matrix(renderer, shown))
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
        # MTimes show all changes but those of the camera; the volume's MTime includes its functions. A producer that
        # replaces its output changes no MTime, so the input object is compared too.
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
            if own.adjust and not (still and window.GetDesiredUpdateRate() < _FULL_QUALITY_RATE):
                # Such a frame is not planned or observed, since VTK's automatic adjustment makes its resolution
                # unknown.
                return
        step = None
        if steered:
            if steering.finest is not None:
                step = max(1 / 64, steering.finest)
            # VTK's GPU mapper draws smaller images only in viewports at the window's origin, and nothing elsewhere.
            placed = self._gpu and renderer.GetOrigin() != (0, 0)
            coarsest_image = pixels if placed else steering.coarsest_image
            limits = (step, self._finest, steering.coarsest, coarsest_image, pixels)
            if limits != self._limits:
                self._set_limits(self._finest if step is None else step, coarsest_image)
                self._limits = limits
        camera = renderer.GetActiveCamera()
        matrix = camera.GetViewTransformMatrix()
        # Keeps Python's wrappers of the camera and the matrix for the next frame.
        steering._camera = camera, matrix
        due, self._due = self._due, None
        before, seconds, processor_seconds, cancelled = _NONE_DUE if due is None else due
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
            processor_seconds,
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

    @property
    def why(self) -> str:
        """str : Reason for the last frame's settings, in a sentence."""
        if self._explained is None:
            return self.status
        return explain(self._explained)


def at_end(renderer: Any, calls: list[Callable[[], None]]) -> None:
    """Makes the calls once, when the renderer's frame ends."""
    tags: list[int] = []

    def ended(_renderer: Any, _event: str) -> None:
        renderer.RemoveObserver(tags[0])
        for call in calls:
            call()

    tags.append(renderer.AddObserver("EndEvent", ended))


def _side(pixels: float) -> int:
    return min(16384, max(1, math.floor(pixels)))


def refusal(volume: Any, wanted: Iterable[Any] = ()) -> str:
    """Reason why a volume cannot be held together with the held volumes and those in `wanted`; empty if it can."""
    mapper = volume.GetMapper()
    why = _mappers.refusal(mapper)
    if why or mapper.IsA("vtkSmartVolumeMapper"):
        # Each volume gets a GPU mapper of its own in place of a smart mapper.
        return why
    others = [*wanted, *(leaf.volume for leaf in _observing)]
    # The settings that steering has written for one volume would be taken for the application's settings of the other
    # volume.
    if any(other is not None and other is not volume and other.GetMapper() is mapper for other in others):
        return "the mapper draws another held volume too; give each volume a mapper of its own"
    return ""


def first_volume(volume: Any) -> Any:
    """The volume itself, or the first of several that one mapper draws together."""
    if not volume.IsA("vtkMultiVolume"):
        return volume
    for port in range(10):
        inner = volume.GetVolume(port)
        if inner is not None:
            return inner
    raise _scene.Unreadable("the vtkMultiVolume has no volume; add one with SetVolume()")
