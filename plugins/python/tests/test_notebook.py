# SPDX-License-Identifier: MIT OR Apache-2.0
"""The tutorial runs from top to bottom with the outputs that its text states."""

from pathlib import Path

import pytest

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")
pytest.importorskip("ipykernel")
pytest.importorskip("pyvista")

NOTEBOOK = Path(__file__).parent.parent / "notebooks" / "tutorial.ipynb"


def test_the_tutorial():
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    assert all(not cell.get("outputs") for cell in notebook.cells)
    nbclient.NotebookClient(notebook, timeout=240, kernel_name="python3").execute()
    shown = [o for cell in notebook.cells for o in cell.get("outputs", []) if "data" in o]
    pictures = [o for o in shown if "<svg" in o["data"].get("text/html", "")]
    assert len(pictures) >= 2
