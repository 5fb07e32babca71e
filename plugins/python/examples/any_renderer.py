# SPDX-License-Identifier: MIT OR Apache-2.0
"""Steers your own renderer: here NumPy takes the maximum of samples along z, at the ray step of the plan.

python any_renderer.py
"""

import time

import numpy as np

import entire

rng = np.random.default_rng(0)
voxels = rng.random((192, 192, 192), np.float32)
volume = entire.Volume(voxels)
tf = entire.TransferFunction.points([(0, 0), (1, 0.02)])


def draw(step):
    at = np.arange(0, len(voxels) - 1, step)
    low = at.astype(int)
    share = (at - low)[:, None, None].astype(np.float32)
    return np.max(voxels[low] * (1 - share) + voxels[low + 1] * share, axis=0)


session = entire.Session(volume)
for frame in range(60):
    plan = session.plan(
        entire.Camera.arcball(0, 0, 2.5), tf, (192, 192), target=0.05, skipping="none", termination=1.0
    )
    began = time.perf_counter()
    draw(plan.step)
    session.observe(plan, time.perf_counter() - began)

print(session.history)
print(plan)
