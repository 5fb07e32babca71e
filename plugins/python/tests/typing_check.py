# SPDX-License-Identifier: MIT OR Apache-2.0
"""Examples of users' code for type checkers; never run."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

import entire

volume: entire.Volume = entire.Volume(np.zeros((4, 4, 4), np.uint16), (1, 1, 2), axes="xyz", range=(0, 100))
tf: entire.TransferFunction = entire.TransferFunction.points([(0, 0), (1, 0.5)])
camera: entire.Camera = entire.Camera.look_at(volume, (0, 0, 50))
parallel: entire.Camera = entire.Camera.arcball(20, 30, 2.5, parallel_scale=0.9)
scale: float | None = parallel.parallel_scale
session: entire.Session = entire.Session(volume, model="unshaded-selected")
clocks: tuple[str | None, str | None] = (session.clock, session.model_clock)
plan: entire.Plan = session.plan(camera, tf, (640, 480), 1 / 30, shading="local")
verdict: str = session.observe(plan, 0.02)
seconds: float = session.predict(camera, None, (640, 480)).seconds
many: npt.NDArray[np.float32] = entire.predict(volume, [(0, 0, 2)], tf, (64, 64))
model: entire.Model = session.calibrate().model
session.plan(camera, tf, (640, 480), "soon")  # type: ignore[arg-type]
session.plan(camera, tf, (640, 480), 0.1, shading="fancy")  # type: ignore[arg-type]
entire.Volume()  # type: ignore[call-arg]
