# SPDX-License-Identifier: MIT OR Apache-2.0
"""A volume of noise for comparisons, bars and tests."""

import numpy as np


def noise_volume(n, seed=7):
    """Returns [z, y, x] bytes: five octaves of value noise, thresholded. Values decrease toward the corners; about 88 % of
    the voxels are not 0."""
    rng = np.random.default_rng(seed)
    total = np.zeros((n, n, n), np.float32)
    weight, cells = 1.0, 4
    for _ in range(5):
        values = rng.random((cells + 1,) * 3, np.float32)
        at = np.linspace(0, cells, n, endpoint=False)
        i, f = at.astype(int), (at - at.astype(int)).astype(np.float32)
        f = f * f * (3 - 2 * f)
        for axis in range(3):
            shape = [1, 1, 1]
            shape[axis] = n
            blend = f.reshape(shape)
            values = values.take(i, axis) * (1 - blend) + values.take(i + 1, axis) * blend
        total += weight * values
        weight, cells = 0.5 * weight, 2 * cells
    at = (np.arange(n, dtype=np.float32) + 0.5) / n * 2 - 1
    radius = np.sqrt(at[:, None, None] ** 2 + at[None, :, None] ** 2 + at[None, None, :] ** 2)
    total = (total - total.min()) / (total.max() - total.min())
    total = np.clip((total - 0.35) / 0.65, 0, 1) * np.clip(1.5 - radius, 0, 1)
    return (255 * total / total.max()).astype(np.uint8)
