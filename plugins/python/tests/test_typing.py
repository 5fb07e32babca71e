# SPDX-License-Identifier: MIT OR Apache-2.0
"""Stubs match the module, users' code matches the stubs, and examples in docstrings give their outputs."""

import doctest
import importlib
import inspect
import os
import subprocess
import sys
from pathlib import Path

import pytest

import entire
from entire import _native

HERE = Path(__file__).parent


def mypy(*arguments):
    pytest.importorskip("mypy")
    command = [sys.executable, "-m", *arguments]
    # In the tests' parent folder, so that mypy checks the installed package and not one in the current folder.
    return subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=HERE.parent)


@pytest.mark.parametrize("what", [("--package", "entire"), ("tests/typing_check.py",)])
def test_stubs_and_users_code(what):
    # Gives mypy the package's name: with a path, mypy would take the other packages in site-packages for its modules.
    run = mypy("mypy", "--config-file", "pyproject.toml", "--cache-dir", os.devnull, *what)
    assert run.returncode == 0, run.stdout


def test_stubs_hold_what_the_module_holds():
    run = mypy("mypy.stubtest", "entire._native", "--ignore-disjoint-bases", "--ignore-missing-stub")
    assert run.returncode == 0, run.stdout


@pytest.mark.parametrize("name", ["entire", "entire._core", "entire._native"])
def test_examples_in_docstrings(name):
    failed, tried = doctest.testmod(importlib.import_module(name), optionflags=doctest.ELLIPSIS)
    assert failed == 0
    del tried


@pytest.mark.parametrize("name", entire.__all__)
def test_everything_is_documented(name):
    thing = getattr(entire, name)
    if isinstance(thing, str):
        return
    assert inspect.getdoc(thing), name
    if inspect.isclass(thing) and not issubclass(thing, Exception):
        for member, value in vars(thing).items():
            if not member.startswith("_") and (callable(value) or isinstance(value, property)):
                text = inspect.getdoc(value) or inspect.getdoc(getattr(thing, member))
                assert text, f"{name}.{member}"


def test_parameters_are_named_in_their_docstrings():
    for owner in (_native.Session, _native.Camera, _native.TransferFunction):
        for member, value in vars(owner).items():
            value = getattr(owner, member)
            if member.startswith("_") or not callable(value):
                continue
            parameters = [p for p in inspect.signature(value).parameters if p != "self"]
            text = inspect.getdoc(value)
            for p in parameters:
                assert p in text, f"{owner.__name__}.{member}: {p}"
