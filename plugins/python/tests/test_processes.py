# SPDX-License-Identifier: MIT OR Apache-2.0
"""Threads, forks and the end of the interpreter."""

import os
import subprocess
import sys
import textwrap
import threading

import numpy as np
import pytest

import entire

CAMERA = entire.Camera.arcball(20, 30, 2.5)


def test_one_session_in_many_threads(voxels, tf):
    session, failures, plans = entire.Session(entire.Volume(voxels)), [], []
    views = np.tile((10.0, 20.0, 2.0), (200, 1))

    def work(i):
        try:
            for k in range(60):
                if i == 0 and k % 10 == 0:
                    session.predict_many(views, tf, (64, 64))
                elif i == 1 and k % 20 == 0:
                    session.set_volume(entire.Volume(voxels))
                else:
                    plan = session.plan(CAMERA, tf, (64, 64), 0.01)
                    plans.append(plan.id)
                    session.observe(plan, 0.01)
        except entire.RejectedObservationError:
            pass
        except Exception as error:
            failures.append(error)

    threads = [threading.Thread(target=work, args=(i,)) for i in range(8)]
    for t in threads:
        t.start()
    for t in threads:
        t.join(60)
    assert not any(t.is_alive() for t in threads)
    assert not failures
    assert len(set(plans)) == len(plans)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_fork_goes_on_and_a_lock_that_was_held_is_said(voxels, tf):
    session = entire.Session(entire.Volume(voxels))
    expected = session.predict(CAMERA, tf, (64, 64)).seconds
    busy = entire.Session(entire.Volume(voxels))
    views = np.tile((10.0, 20.0, 2.0), (60_000, 1))
    started = threading.Event()

    def long():
        started.set()
        busy.predict_many(views, tf, (640, 480))

    thread = threading.Thread(target=long)
    thread.start()
    started.wait()
    import time

    time.sleep(0.2)
    child = os.fork()
    if child == 0:
        code = 1
        try:
            same = session.predict(CAMERA, tf, (64, 64)).seconds == expected
            try:
                busy.plan(CAMERA, tf, (64, 64), 0.01)
                said = False
            except RuntimeError as error:
                said = "forked" in str(error)
            fresh = entire.predict(voxels, views[:50], tf, (64, 64)).shape == (50,)
            code = 0 if same and said and fresh else 2
        finally:
            os._exit(code)
    thread.join()
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def test_the_interpreter_may_end_at_any_time():
    program = """
        import threading, numpy as np, entire
        volume = entire.Volume(np.random.default_rng(0).integers(0, 255, (48, 48, 48), np.uint8))
        tf = entire.TransferFunction.points([(0, 0), (1, 0.2)])
        session = entire.Session(volume)
        started = threading.Event()
        def work():
            started.set()
            while True:
                session.predict_many(np.tile((10.0, 20.0, 2.0), (5000, 1)), tf, (64, 64))
        threading.Thread(target=work, daemon=True).start()
        started.wait()
        module_level = (volume, tf, session, entire.Model("unshaded-selected"))
        print("done")
    """
    run = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program)], capture_output=True, text=True, timeout=60
    )
    assert (run.returncode, run.stdout.strip(), run.stderr) == (0, "done", "")


def test_python_m_entire_and_the_command_are_one():
    run = subprocess.run(
        [sys.executable, "-m", "entire", "--version"], capture_output=True, text=True, timeout=60
    )
    assert run.returncode == 0
    assert run.stdout.split()[-1] == entire.__version__
    wrong = subprocess.run(
        [sys.executable, "-m", "entire", "encode", "nothing.nrrd"], capture_output=True, text=True, timeout=60
    )
    assert wrong.returncode in (1, 2)
    assert wrong.stderr


def test_a_farm_starts_its_workers(voxels, tmp_path):
    voxels.tofile(tmp_path / "v.raw")
    sizes = " ".join(str(n) for n in voxels.shape[::-1])
    kind = {"uint8": "uchar", "uint16": "ushort", "float32": "float"}[voxels.dtype.name]
    (tmp_path / "v.nhdr").write_text(
        f"NRRD0004\ntype: {kind}\ndimension: 3\nsizes: {sizes}\nencoding: raw\nendian: little\ndata file: v.raw\n"
    )
    (tmp_path / "job.toml").write_text(
        'name = "db"\nsizes = ["16x16"]\n[[volumes]]\nfiles = ["v.nhdr"]\n'
        '[[cameras]]\nkind = "orbit"\nviews = 2\nelevation_deg = 15.0\ndistances_radii = [2.5]\n'
        '[[transfer]]\nname = "one"\nlobes = [[0.5, 0.05, 0.4]]\n[renderer]\nkind = "entire"\ndevice = "cpu"\n'
    )
    run = subprocess.run(
        [sys.executable, "-m", "entire", "farm", "job.toml", "--slots", "1", "--quiet"],
        capture_output=True, text=True, timeout=60, cwd=tmp_path,
    )
    assert run.returncode == 0, run.stderr
    assert "2 of 2 images" in run.stdout
