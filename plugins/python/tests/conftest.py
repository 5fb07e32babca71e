# SPDX-License-Identifier: MIT OR Apache-2.0
import os
import sys
from pathlib import Path

import pytest

# Folder of the modules that make volumes and windows; the tests of the C++ class use them too.
sys.path.append(str(Path(__file__).resolve().parents[2] / "vtk" / "python"))
os.environ.setdefault("PYVISTA_OFF_SCREEN", "false")


@pytest.fixture(scope="session")
def voxels():
    from vtk_noise import noise_volume

    return noise_volume(48)


@pytest.fixture
def tf():
    import entire

    return entire.TransferFunction.points([(0, 0), (0.2, 0), (1, 0.2)])
