# SPDX-License-Identifier: MIT OR Apache-2.0
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, final

import numpy as np
import numpy.typing as npt
from typing_extensions import Self

_Shading = Literal["none", "local", "scatter", "local-scatter"]
_Skipping = Literal["blocks", "none", "distance"]
_Size = Sequence[int]
_Range = Sequence[float]
_Triple = tuple[float, float, float] | Sequence[float]
_Rows = Sequence[Sequence[float]] | npt.NDArray[Any]

__version__: str
simd_level: str

class ModelError(ValueError): ...
class MissingInputError(ValueError): ...
class NotReadyError(RuntimeError): ...
class RejectedObservationError(ValueError): ...

def command(args: Sequence[str]) -> int: ...
def machine_file(shading: str) -> Path: ...
def write_whole(path: str | os.PathLike[str], data: bytes) -> None: ...

@final
class Volume:
    def __new__(
        cls,
        array: npt.ArrayLike,
        spacing: _Triple = ...,
        *,
        origin: _Triple = ...,
        axes: Literal["zyx", "xyz"] = "zyx",
        range: _Range | None = None,
        fill: Literal["auto"] | float | Sequence[float] | None = ...,
    ) -> Self: ...
    def next(
        self,
        array: npt.ArrayLike,
        changed: Sequence[_Size] | None = None,
    ) -> Volume: ...
    @property
    def shape(self) -> tuple[int, int, int]: ...
    @property
    def spacing(self) -> tuple[float, float, float]: ...
    @property
    def center(self) -> tuple[float, float, float]: ...
    @property
    def radius(self) -> float: ...
    @property
    def range(self) -> tuple[float, float]: ...
    @property
    def reference_step(self) -> float: ...
    @property
    def copied(self) -> bool: ...
    @property
    def array(self) -> npt.NDArray[Any]: ...

@final
class Camera:
    @staticmethod
    def arcball(
        rx: float, ry: float, dz: float, fov: float = ..., *, parallel_scale: float | None = None
    ) -> Camera: ...
    @staticmethod
    def look_at(
        volume: Volume,
        eye: _Triple,
        target: _Triple | None = None,
        up: _Triple = ...,
        fov: float = ...,
        *,
        parallel_scale: float | None = None,
    ) -> Camera: ...
    @staticmethod
    def view(
        volume: Volume,
        matrix: Sequence[Sequence[float]] | npt.NDArray[np.floating[Any]],
        fov: float = ...,
        *,
        parallel_scale: float | None = None,
    ) -> Camera: ...
    @staticmethod
    def scene(
        volume: Volume,
        to_eye: Sequence[float],
        to_world: Sequence[float],
        direction: Sequence[float],
        center: _Triple,
        fov: float,
        parallel_scale: float | None = None,
    ) -> Camera: ...
    @staticmethod
    def projection(
        volume: Volume, matrix: Sequence[Sequence[float]] | npt.NDArray[np.floating[Any]]
    ) -> Camera: ...
    def jumps_from(self, before: Camera) -> bool: ...
    @property
    def pose(self) -> tuple[float, float, float]: ...
    @property
    def fov(self) -> float | None: ...
    @property
    def parallel_scale(self) -> float | None: ...

@final
class TransferFunction:
    @staticmethod
    def lobes(
        lobes: _Rows,
        *,
        unit_distance: float | None = None,
        unit_length: float | None = None,
    ) -> TransferFunction: ...
    @staticmethod
    def points(
        points: _Rows,
        *,
        unit_distance: float | None = None,
        unit_length: float | None = None,
    ) -> TransferFunction: ...
    @staticmethod
    def nodes(
        opacity: _Rows,
        color: _Rows = ...,
        *,
        range: _Range,
        clamp: bool = True,
        unit_distance: float | None = None,
        unit_length: float | None = None,
    ) -> TransferFunction: ...
    @staticmethod
    def table(
        samples: npt.ArrayLike, *, unit_distance: float | None = None, unit_length: float | None = None
    ) -> TransferFunction: ...
    @property
    def rgba(self) -> npt.NDArray[np.float32]: ...

class Model:
    def __new__(cls, data: bytes) -> Self: ...
    def encode(self, volume: Volume) -> npt.NDArray[np.float32]: ...
    @property
    def inputs(self) -> list[tuple[str, int]]: ...
    @property
    def metadata(self) -> dict[str, str]: ...
    @property
    def predicts(self) -> bool: ...
    @property
    def encodes(self) -> bool: ...
    def to_bytes(self) -> bytes: ...

@final
class Plan:
    @property
    def id(self) -> int: ...
    @property
    def step(self) -> float: ...
    @property
    def image_sample_distance(self) -> float: ...
    @property
    def size(self) -> tuple[int, int]: ...
    @property
    def seconds(self) -> float: ...
    @property
    def upper(self) -> float: ...
    @property
    def out_of_range(self) -> float: ...
    @property
    def reason(self) -> str: ...
    @property
    def target(self) -> float: ...

@final
class Prediction:
    @property
    def seconds(self) -> float: ...
    @property
    def upper(self) -> float: ...
    @property
    def out_of_range(self) -> float: ...
    @property
    def source(self) -> str: ...
    def __float__(self) -> float: ...

@final
class FrameBudget:
    def __new__(cls) -> Self: ...
    def begin(self, volumes: int, /) -> None: ...
    def share(self, passed: PassShare, target: float, /) -> float: ...
    def drew(self, passed: PassShare, seconds: float, full: float, /) -> None: ...
    def end(self, seconds: float, usual: bool, /) -> None: ...

@final
class PassShare:
    def __new__(cls) -> Self: ...

@final
class Held:
    def __new__(
        cls,
        volume: Volume,
        to_world: Sequence[float],
        direction: Sequence[float],
        center: _Triple,
        *,
        step: float,
        shading: _Shading,
        skipping: _Skipping,
        termination: float,
    ) -> Self: ...

class Session:
    def __new__(
        cls,
        volume: Volume | None = None,
        *,
        model: Model | None = None,
        tolerance: float = 0.1,
        miss_rate: float = 0.05,
        trust_limit: float = 2.0,
        damping: bool = True,
        ignore_load: bool = False,
        probe_side: int | None = None,
        probe_tolerance: float = 0.0,
    ) -> Self: ...
    def set_volume(self, volume: Volume) -> None: ...
    def set_transfer_function(self, tf: TransferFunction) -> None: ...
    def set_limits(self, finest: float, coarsest: float) -> None: ...
    def set_max_image_sample_distance(self, coarsest: float, step_alone: float = 1.0) -> None: ...
    def set_quality(
        self,
        image_weight: float | None,
        step_exponent: float = 1.0,
        image_exponent: float = 1.0,
        ray_share: float = 0.0,
    ) -> None: ...
    @property
    def quality(self) -> tuple[float, float, float, float] | None: ...
    def set_enabled(self, enabled: bool) -> None: ...
    def mark(self, *, camera: bool = False, mode: bool = False, first: bool = False) -> None: ...
    def plan(
        self,
        camera: Camera,
        tf: TransferFunction | None,
        size: _Size,
        target: float,
        *,
        step: float = 1.0,
        shading: _Shading = "none",
        skipping: _Skipping = "blocks",
        termination: float = 0.99,
    ) -> Plan: ...
    def steer(
        self,
        held: Held,
        to_eye: tuple[float, ...],
        fov: float,
        parallel_scale: float | None,
        size: tuple[int, int],
        target: float,
        step: float | None = None,
        enabled: bool = True,
        due: Plan | None = None,
        seconds: float = ...,
        processor_seconds: float = ...,
        cancelled: bool = False,
    ) -> tuple[Plan, float, float]: ...
    def choose(
        self,
        camera: Camera,
        tf: TransferFunction | None,
        size: _Size,
        target: float,
        settings: Sequence[tuple[float, _Size]],
        *,
        shading: _Shading = "none",
        skipping: _Skipping = "blocks",
        termination: float = 0.99,
    ) -> tuple[int, Plan]: ...
    def observe(
        self,
        plan: Plan,
        seconds: float,
        *,
        unusual: bool = False,
        cancelled: bool = False,
        processor_seconds: float = ...,
    ) -> str: ...
    def predict(
        self,
        camera: Camera,
        tf: TransferFunction | None,
        size: _Size,
        *,
        step: float = 1.0,
        shading: _Shading = "none",
        skipping: _Skipping = "blocks",
        termination: float = 0.99,
    ) -> Prediction: ...
    def predict_many(
        self,
        cameras: Sequence[Camera] | npt.ArrayLike,
        tf: TransferFunction | None,
        size: _Size,
        *,
        step: float = 1.0,
        shading: _Shading = "none",
        skipping: _Skipping = "blocks",
        termination: float = 0.99,
        fov: float = 45.0,
    ) -> npt.NDArray[np.float32]: ...
    def reset(self) -> None: ...
    def set_timing_source(self, renderer: str, clock: str) -> None: ...
    @property
    def clock(self) -> str | None: ...
    @property
    def model_clock(self) -> str | None: ...
    def save_state(self) -> bytes: ...
    def load_state(self, state: bytes) -> None: ...
    def columns(self) -> dict[str, Any]: ...
    def record_from(self, frames: int, model: Model | None) -> None: ...
    @property
    def recorded(self) -> int | None: ...
    def record_picture(
        self, scene: int, step: float, image_sample_distance: float, seconds: float, error: float
    ) -> None: ...
    def calibrate_bytes(self) -> tuple[bytes, dict[str, Any]]: ...
    def steer_by(self, model: Model) -> None: ...
