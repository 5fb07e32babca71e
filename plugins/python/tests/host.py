# SPDX-License-Identifier: MIT OR Apache-2.0
"""Runs pytest with the VTK of the running Python (a distribution's, ParaView's), and with the wheel and pytest of an
environment.

PYTHON host.py SITE_PACKAGES ARGUMENT...
"""

import sys

# After the running Python's own folders.
sys.path = [folder for folder in sys.path if folder] + [sys.argv[1]]

import pytest  # noqa: E402
from vtkmodules.vtkCommonCore import vtkVersion  # noqa: E402

print(f"VTK {vtkVersion().GetVTKVersion()}", flush=True)
sys.exit(pytest.main(sys.argv[2:]))
