# SPDX-License-Identifier: MIT OR Apache-2.0
"""Memory does not grow over repeated use; `make bars-python` runs many more cycles."""

import gc
import os

import numpy as np
import pytest

import entire

PAGE = os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else 4096
CAMERA = entire.Camera.arcball(20, 30, 2.5)


def resident():
    if not os.path.exists("/proc/self/statm"):
        pytest.skip("no /proc here to read the resident memory from")
    gc.collect()
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * PAGE


def growth(cycle, warm, count):
    for _ in range(warm):
        cycle()
    before = resident()
    for _ in range(count):
        cycle()
    return resident() - before


def test_sessions(tf):
    voxels = np.random.default_rng(0).integers(0, 255, (16, 16, 16), np.uint8)

    def cycle():
        session = entire.Session(entire.Volume(voxels))
        plan = session.plan(CAMERA, tf, (64, 64), 0.01)
        session.observe(plan, 0.01)

    assert growth(cycle, 500, 4000) < 1 << 20


def test_errors(tf):
    def cycle():
        with pytest.raises(ValueError):
            entire.Volume(np.zeros((2, 2)))
        with pytest.raises(entire.ModelError):
            entire.Model(b"nothing at all")

    assert growth(cycle, 500, 3000) < 1 << 20


@pytest.mark.parametrize("kind", ["gpu", "smart"])
def test_attaching(voxels, kind):
    pytest.importorskip("vtkmodules")
    import entire.vtk

    from scenes import View, add_volume

    view = View((32, 32))
    volume = add_volume(view.renderer, voxels[:16, :16, :16], kind)

    def cycle():
        entire.vtk.hold(view.renderer, volume, 0.01, overlay=True).detach()

    assert growth(cycle, 200, 1000) < 1 << 20


def test_a_weak_reference_yields_no_object_that_is_deleted_meanwhile():
    """The collections that an allocation starts in Python up to 3.11 may delete an object that only garbage owns."""
    pytest.importorskip("vtkmodules")
    from entire.vtk._weak import weak
    from vtkmodules.vtkRenderingCore import vtkRenderer, vtkVolume

    before, deleted = gc.get_threshold(), []
    gc.collect()
    gc.disable()
    try:
        for _ in range(20):
            volume, garbage = vtkVolume(), [vtkRenderer()]
            volume.AddObserver("DeleteEvent", lambda *_: deleted.append(1))
            # Only the renderer owns the volume, and only a cycle of Python owns the renderer.
            garbage[0].AddVolume(volume)
            garbage.append(garbage)
            reference = weak(volume)
            del volume, garbage
            gc.set_threshold(1)
            gc.enable()
            held = reference()
            gc.disable()
            gc.set_threshold(*before)
            count = len(deleted)
            if held is not None:
                assert held.GetReferenceCount() == 2
            del held
            gc.collect()
            assert reference() is None
            assert len(deleted) == count + 1
    finally:
        gc.set_threshold(*before)
        gc.enable()
