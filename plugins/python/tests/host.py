# SPDX-License-Identifier: MIT OR Apache-2.0
"""Runs pytest with the VTK of this Python (of a distribution or ParaView), and the wheel and pytest of an environment.

PYTHON host.py SITE_PACKAGES ARGUMENT...
"""

import sys

# The environment comes last, so that this Python's own VTK and NumPy are imported.
sys.path = [folder for folder in sys.path if folder] + [sys.argv[1]]

import pytest  # noqa: E402
from vtkmodules.vtkCommonCore import vtkVersion  # noqa: E402

print(f"VTK {vtkVersion().GetVTKVersion()}", flush=True)
sys.exit(pytest.main(sys.argv[2:]))
