# SPDX-License-Identifier: MIT OR Apache-2.0
"""Version, dependencies and entry points agree in all files of the package."""

import re
from importlib import metadata
from pathlib import Path

import pytest

import entire

HERE = Path(__file__).resolve().parents[1]


def test_versions_agree():
    assert metadata.version("entire") == entire.__version__
    recipe = (HERE / "conda" / "recipe.yaml").read_text()
    assert re.search(r'version: "(.*)"', recipe)[1] == entire.__version__
    assert f'version = "{entire.__version__}"' in (HERE.parents[1] / "Cargo.toml").read_text()


def test_extras_and_entry_points():
    assert set(metadata.metadata("entire").get_all("Provides-Extra")) == {"vtk", "pyvista", "napari", "farm"}
    required = [r for r in metadata.requires("entire") if "extra ==" not in r]
    assert [re.match(r"[\w-]+", r)[0] for r in required] == ["numpy"]
    assert metadata.metadata("entire").get_all("License-File") == ["LICENSE-APACHE", "LICENSE-MIT"]
    named = {(e.group, e.name): e.value for e in metadata.distribution("entire").entry_points}
    assert named["pyvista.plotter_components", "entire"] == "entire.pyvista"
    assert named["console_scripts", "entire"] == "entire._command:main"
    package = Path(entire.__file__).parent
    assert (package / "py.typed").is_file()
    assert (package / "_native.pyi").is_file()


@pytest.mark.parametrize("name", ["build", "test", "oldest", "qt", "slicer", "trame-slicer"])
def test_versions_are_locked(name):
    for line in (HERE / f"requirements-{name}.txt").read_text().split():
        assert re.fullmatch(r"[\w.-]+==[\w.]+", line), line
