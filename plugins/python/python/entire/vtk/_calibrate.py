# SPDX-License-Identifier: MIT OR Apache-2.0
"""Calibration to the application's own renderer, so that the first frame is predicted too."""

from __future__ import annotations

import contextlib
import itertools
import logging
import math
import random
from typing import Any, Callable

import numpy as np
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkRenderingCore import vtkWindowToImageFilter

from .._clocks import timer
from .._core import CannotSteer, Model, Session
from . import _mappers, _scene
from ._leaf import first_volume
from ._steering import _check_renderer, _volumes

log = logging.getLogger("entire.vtk")

# Sample distances (as multiples of the finest) and image sample distances (as multiples of the mapper's own) of the
# pictures that are compared with full quality.
_STEPS = (1.0, 1.5, 2.2, 3.3)
_IMAGES = (1.0, 1.3, 1.7)

# Image sample distances, in pixels, of the frames to which costs are fitted; number of consecutive frames with each.
_SIZES = (1.0, 2.0, 1.0, 4.0)
_FRAMES_PER_SIZE = 6


def rmse(picture: np.ndarray, full: np.ndarray) -> float:
    """Root mean square difference of two pictures' colors."""
    return float(np.sqrt(np.mean((picture.astype(np.float32) - full) ** 2)))


def calibrate(
    renderer: Any,
    volume: Any = None,
    frames: int = 60,
    *,
    seed: int = 0,
    coarsest: float = 8.0,
    clock: str = "wall",
    pictures: int = 4,
    picture_error: Callable[[np.ndarray, np.ndarray], float] = rmse,
) -> Model:
    """Draws random frames of a volume in its window and fits the cost model to its mapper's times.

    Directions, distances, steps and the opacity of the volume are varied. Then some scenes are drawn with coarser
    steps, as smaller images, and with both, and each picture is compared with full quality. Steering with the model
    then coarsens step or image, whichever adds less error. Camera, mapper and property are restored afterwards, and the
    window is drawn once more.

    Parameters
    ----------
    renderer : vtkRenderer
    volume : vtkVolume, optional
        Default: the renderer's first volume. Its mapper must be the GPU or the fixed-point mapper; :func:`hold`
        exchanges a smart mapper for a GPU mapper.
    frames : int, optional
        Number of frames to draw, 10 to 65536. Default 60.
    seed : int, optional
        Seed of the random frames. Default 0.
    coarsest : float, optional
        Coarsest sample distance, in smallest voxel spacings. Default 8.
    clock : {"wall", "cpu"}, optional
        As in :func:`hold`. The model's metadata record the clock and the mapper's class.
    pictures : int, optional
        Number of scenes to compare, each drawn 24 times; 0 for none, else at least 3. Default 4.
    picture_error : callable, optional
        Function of a picture and the picture at full quality, both as [y, x, rgb] bytes, that returns their
        difference: 0 for equal pictures, and larger for more different ones. Default: root mean square difference
        of colors. 1 - SSIM (structural similarity) is suitable too.

    Returns
    -------
    Model
        For ``model=`` of :func:`hold`, :class:`entire.Session` and :func:`entire.predict`.

    Raises
    ------
    CannotSteer
        If the mapper cannot be steered.
    ValueError
        For too few frames, another clock, a volume that is not drawn, or a scene that cannot be read.
    """
    if pictures and pictures < 3:
        raise ValueError(f"pictures is {pictures}; at least 3 scenes are needed for a quality law, or 0 for none")
    if not 10 <= frames <= 65536:
        raise ValueError(f"frames is {frames}; at least 10 and at most 65536 are accepted; 60 are enough")
    _check_renderer(renderer)
    if renderer.GetRenderWindow() is None:
        raise ValueError("the renderer has no window; add it to one with AddRenderer()")
    if volume is None:
        volume = next(iter(_volumes(renderer)), None)
        if volume is None:
            raise ValueError("the renderer has no volume; add one with AddVolume() first")
    elif volume not in _volumes(renderer):
        raise ValueError("the volume is not in this renderer; add it with AddVolume(), or pass its own renderer")
    mapper = volume.GetMapper()
    if mapper is None or not (_mappers.is_gpu(mapper) or _mappers.is_fixed_point(mapper)):
        why = (
            _mappers.refusal(mapper)
            or "hold the volume first: its vtkSmartVolumeMapper is then exchanged for a GPU mapper"
        )
        raise CannotSteer(why)
    return _Calibrator(renderer, volume, mapper, clock).run(frames, seed, coarsest, pictures, picture_error)


class _Calibrator:
    def __init__(self, renderer: Any, volume: Any, mapper: Any, clock: str) -> None:
        self.renderer, self.volume, self.mapper = renderer, volume, mapper
        self.clock, self.now = clock, timer(clock)
        self.gpu = _mappers.is_gpu(mapper)
        self.window = renderer.GetRenderWindow()
        self.began = self.seconds = math.nan

    # The frames of a calibration are timed in the same way as steered frames.
    def start(self, _mapper: Any, _event: str) -> None:
        if self.gpu:
            self.window.WaitForCompletion()
        self.began = self.now()

    def end(self, _mapper: Any, _event: str) -> None:
        if self.gpu:
            self.window.WaitForCompletion()
        self.seconds = self.now() - self.began

    def run(
        self,
        frames: int,
        seed: int,
        coarsest: float,
        pictures: int,
        error: Callable[[np.ndarray, np.ndarray], float],
    ) -> Model:
        from ._steering import _holder

        renderer, mapper, window = self.renderer, self.mapper, self.window
        prop = first_volume(self.volume).GetProperty()
        steering = _holder(self.volume)
        camera, own = renderer.GetActiveCamera(), _mappers.Settings(mapper)
        unit = prop.GetScalarOpacityUnitDistance(0)
        kept = {
            name: getattr(camera, "Get" + name)()
            for name in ("FocalPoint", "Position", "ViewUp", "ClippingRange")
        }
        tags = [
            mapper.AddObserver("VolumeMapperRenderStartEvent", self.start, -1.0),
            mapper.AddObserver("VolumeMapperRenderEndEvent", self.end, 1.0),
        ]
        quiet = contextlib.ExitStack()
        try:
            if steering is not None:
                # Hides the overlay and turns steering off.
                quiet.enter_context(steering.still())
            # In a renderer that is not at the window's lower left corner, the GPU mapper draws nothing if the image
            # sample distance is over about 1.4.
            shrinks = not self.gpu or renderer.GetOrigin() == (0, 0)
            if pictures and not shrinks:
                log.warning(
                    "pictures are not compared: the GPU mapper draws smaller images only in renderers at the window's "
                    "lower left corner"
                )
                pictures = 0
            window.Render()
            image = _scene.input_of(mapper)
            grid = _scene.Grid(mapper, image, 0 if prop.GetIndependentComponents() else -1)
            placed = _scene.elements(_scene.drawn_matrix(renderer, first_volume(self.volume)))
            finest = _mappers.full_quality(own, image, placed, self.gpu)
            base = min(4096.0, max(1 / 64, finest / grid.reference))
            session, draw = Session(grid.volume), random.Random(seed)
            session.set_timing_source(mapper.GetClassName(), self.clock)
            session.set_enabled(False)
            session.record(frames)
            bounds = self.volume.GetBounds()
            if not renderer.HasViewProp(self.volume):
                # GetBounds() of a volume in an assembly leaves out the assembly's matrix.
                ends = mapper.GetBounds()
                corners = [
                    [placed[4 * a + 3] + sum(placed[4 * a + b] * at[b] for b in range(3)) for a in range(3)]
                    for at in itertools.product(ends[:2], ends[2:4], ends[4:])
                ]
                bounds = [end(corner[a] for corner in corners) for a in range(3) for end in (min, max)]
            middle = [0.5 * (bounds[2 * a] + bounds[2 * a + 1]) for a in range(3)]
            radius = 0.5 * math.dist(bounds[::2], bounds[1::2])
            _mappers.write(mapper, own, base * grid.reference, 1.0)
            for i in range(frames + 1):
                self.pose(camera, draw, middle, radius)
                prop.SetScalarOpacityUnitDistance(0, unit * 2 ** draw.uniform(-3, 3))
                step = base * (max(coarsest, base) / base) ** draw.random()
                mapper.SetSampleDistance(step * grid.reference)
                if i % _FRAMES_PER_SIZE == 0:
                    # Steering draws smaller images too. The first frame of a size creates buffers and is not timed.
                    distance = _SIZES[i // _FRAMES_PER_SIZE % len(_SIZES)] if shrinks else 1.0
                    mapper.SetImageSampleDistance(distance)
                    window.Render()
                self.seconds = math.nan
                window.Render()
                if math.isnan(self.seconds):
                    raise ValueError("the volume was not drawn; make it and its renderer visible")
                look = _scene.look(prop, mapper)
                width, height = renderer.GetSize()
                # The session does not record its first frame, which includes one-time work.
                plan = session.plan(
                    _scene.camera(renderer, placed, grid),
                    _scene.transfer_function(_scene.transfer_nodes(prop, grid.range)),
                    (max(1, int(width / distance)), max(1, int(height / distance))),
                    target=1.0,
                    step=step,
                    shading="local" if look[0] else "none",
                    skipping="none" if self.gpu else "blocks",
                    termination=_scene.termination(look, self.gpu),
                )
                session.observe(plan, self.seconds)
            for scene in range(pictures):
                self.pose(camera, draw, middle, radius)
                prop.SetScalarOpacityUnitDistance(0, unit * 2 ** draw.uniform(-2, 2))
                self.compare(session, scene, own, base * grid.reference, error)
            return session.calibrate().model
        finally:
            for tag in tags:
                mapper.RemoveObserver(tag)
            prop.SetScalarOpacityUnitDistance(0, unit)
            mapper.SetAutoAdjustSampleDistances(own.adjust)
            mapper.SetLockSampleDistanceToInputSpacing(own.lock)
            mapper.SetSampleDistance(own.sample)
            mapper.SetImageSampleDistance(own.image)
            for name, value in kept.items():
                getattr(camera, "Set" + name)(*value)
            quiet.close()
            window.Render()

    def compare(
        self,
        session: Session,
        scene: int,
        own: _mappers.Settings,
        finest: float,
        error: Callable[[np.ndarray, np.ndarray], float],
    ) -> None:
        """Draws the view at every pair of step and image sample distance, and compares it with full quality."""
        # Under automatic adjustment, the mapper's own image sample distance is that of its last frame.
        base = 1.0 if own.adjust else own.image
        full = None
        for image in _IMAGES:
            for step in _STEPS:
                self.mapper.SetSampleDistance(step * finest)
                self.mapper.SetImageSampleDistance(base * image)
                # Twice, since the first frame creates buffers and tables.
                self.window.Render()
                self.window.Render()
                picture = self.picture()
                full = picture if full is None else full
                session.record_picture(scene, step, image, self.seconds, error(picture, full))

    def picture(self) -> np.ndarray:
        """Pixels of the window, as [y, x, rgb] bytes."""
        grab = vtkWindowToImageFilter()
        grab.SetInput(self.window)
        grab.ShouldRerenderOff()
        grab.ReadFrontBufferOff()
        grab.Update()
        out = grab.GetOutput()
        width, height, _ = out.GetDimensions()
        pixels: np.ndarray = vtk_to_numpy(out.GetPointData().GetScalars())
        return pixels.reshape(height, width, -1)[:, :, :3].copy()

    def pose(self, camera: Any, draw: random.Random, middle: list[float], radius: float) -> None:
        azimuth, height = draw.uniform(0, 2 * math.pi), draw.uniform(-0.95, 0.95)
        across = math.sqrt(1 - height * height)
        distance = radius * draw.uniform(1.4, 4.0)
        toward = (across * math.sin(azimuth), height, across * math.cos(azimuth))
        camera.SetFocalPoint(*middle)
        camera.SetPosition(*(m + distance * t for m, t in zip(middle, toward)))
        camera.SetViewUp(0, 1, 0)
        self.renderer.ResetCameraClippingRange()
