# SPDX-License-Identifier: MIT OR Apache-2.0
"""Predictions of many views at once equal single ones bit for bit, and other threads run meanwhile."""

import threading
import time

import numpy as np
import pytest

import entire


def poses(n, seed=1):
    return np.random.default_rng(seed).uniform((-80, 0, 1.2), (80, 360, 4), (n, 3)).astype(np.float32)


@pytest.mark.parametrize("model", [None, "unshaded-selected", "local-selected", "scatter-selected"])
def test_the_same_bits_as_one_by_one(voxels, tf, model):
    volume = entire.Volume(voxels, (1, 1, 1.5))
    shading = (model or "none").replace("unshaded-selected", "none").split("-")[0]
    views = poses(300)
    lobes = entire.TransferFunction.lobes([(0.6, 0.02, 0.3)])
    for function in (tf, lobes):
        together = entire.predict(volume, views, function, (320, 200), model=model, shading=shading, step=1.5)
        session = entire.Session(volume, model=model)
        alone = [
            session.predict(
                entire.Camera.arcball(*map(float, v)), function, (320, 200), shading=shading, step=1.5
            ).seconds
            for v in views
        ]
        assert together.dtype == np.float32
        assert together.tobytes() == np.array(alone, np.float32).tobytes()
        assert (together > 0).all()


def test_cameras_objects_and_matrices_agree(voxels, tf):
    volume = entire.Volume(voxels)
    views = poses(40)
    cameras = [entire.Camera.arcball(*map(float, v)) for v in views]
    by_pose = entire.predict(volume, views, tf, (320, 200))
    assert np.array_equal(by_pose, entire.predict(volume, cameras, tf, (320, 200)))
    matrices = []
    for rx, ry, dz in np.radians(views * (1, 1, 0)) + views * (0, 0, 1):
        toward = np.array((np.cos(rx) * np.sin(ry), np.sin(rx), np.cos(rx) * np.cos(ry)))
        right = np.cross((0, 1, 0), toward)
        right /= np.linalg.norm(right)
        rotation = np.stack((right, np.cross(toward, right), toward))
        matrix = np.eye(4)
        matrix[:3, :3] = rotation
        matrix[:3, 3] = -rotation @ (np.array(volume.center) + toward * dz * volume.radius)
        matrices.append(matrix)
    assert np.allclose(by_pose, entire.predict(volume, np.array(matrices), tf, (320, 200)), rtol=1e-3)
    assert entire.predict(volume, np.zeros((0, 3)), tf, (320, 200)).shape == (0,)


def test_bad_views_are_named(voxels, tf):
    views = poses(10)
    views[7, 2] = -1
    with pytest.raises(ValueError, match="camera 7: camera distance"):
        entire.predict(voxels, views, tf, (64, 64))
    with pytest.raises(TypeError, match="shape"):
        entire.predict(voxels, np.zeros((5, 7)), tf, (64, 64))
    with pytest.raises(ValueError, match="image size"):
        entire.predict(voxels, poses(3), tf, (0, 64))


def test_an_array_like_object_may_use_the_session(voxels, tf):
    session, done = entire.Session(entire.Volume(voxels)), []

    class Views:
        def __array__(self, dtype=None, copy=None):
            session.predict(entire.Camera.arcball(0, 0, 2), tf, (64, 64))
            return poses(3)

    def work():
        done.append(session.predict_many(Views(), tf, (64, 64)))

    # In a thread, so that a deadlock fails this test instead of blocking it.
    worker = threading.Thread(target=work, daemon=True)
    worker.start()
    worker.join(60)
    assert [len(seconds) for seconds in done] == [3]


def test_other_threads_run_meanwhile(voxels, tf):
    volume, views = entire.Volume(voxels), poses(20_000)
    ticks, done = [], threading.Event()

    def tick():
        while not done.is_set():
            ticks.append(time.perf_counter())
            time.sleep(0.001)

    entire.predict(volume, views[:10], tf, (320, 200))
    watcher = threading.Thread(target=tick)
    watcher.start()
    before = time.perf_counter()
    entire.predict(volume, views, tf, (320, 200))
    after = time.perf_counter()
    done.set()
    watcher.join()
    assert len([t for t in ticks if before < t < after]) > 10
