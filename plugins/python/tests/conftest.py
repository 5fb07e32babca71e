# SPDX-License-Identifier: MIT OR Apache-2.0
import os

import numpy as np
import pytest

# One thread for the software renderer where the tests run beside others.
os.environ.setdefault("PYVISTA_OFF_SCREEN", "false")


def noise(n, seed=7):
    """Smooth noise, 60 % of it not empty, as bytes [z, y, x]."""
    rng = np.random.default_rng(seed)
    total = np.zeros((n, n, n), np.float32)
    weight, cells = 1.0, 4
    for _ in range(4):
        values = rng.random((cells + 1,) * 3, np.float32)
        at = np.linspace(0, cells, n, endpoint=False)
        i, f = at.astype(int), (at - at.astype(int)).astype(np.float32)
        for axis in range(3):
            shape = [1, 1, 1]
            shape[axis] = n
            blend = f.reshape(shape)
            values = values.take(i, axis) * (1 - blend) + values.take(i + 1, axis) * blend
        total += weight * values
        weight, cells = 0.5 * weight, 2 * cells
    total = np.clip((total - total.min()) / np.ptp(total) * 1.5 - 0.5, 0, 1)
    return (255 * total / total.max()).astype(np.uint8)


@pytest.fixture(scope="session")
def voxels():
    return noise(48)


@pytest.fixture
def tf():
    import entire

    return entire.TransferFunction.points([(0, 0), (0.2, 0), (1, 0.2)])
