# SPDX-License-Identifier: MIT OR Apache-2.0
import math
from pathlib import Path

import numpy as np
import pytest

import entire
from entire import _core

CAMERA = entire.Camera.arcball(20, 30, 2.5)


def drawn(plan, speed=1.0):
    """Seconds of a renderer with a fixed cost per frame and a cost per sample of the plan."""
    return speed * (1e-3 + 2e-7 * plan.size[0] * plan.size[1] / plan.step)


def test_a_loop_meets_its_target(voxels, tf):
    session = entire.Session(entire.Volume(voxels))
    late = []
    for i in range(120):
        plan = session.plan(entire.Camera.arcball(20, 2 * i, 2.5), tf, (640, 480), target=0.01)
        assert 1 <= plan.step <= 16
        session.observe(plan, drawn(plan))
        late.append(drawn(plan) / 0.01)
    assert np.mean(np.abs(np.array(late[10:]) - 1)) < 0.1
    history = session.history
    assert len(history) == 120
    assert np.allclose(history.measured, np.float32(0.01) * np.array(late), rtol=1e-5)
    assert history.relative_error()[20:].mean() < 0.1
    assert set(history.reason) <= {
        "fits",
        "held",
        "damped",
        "finest allowed",
        "history",
        "target unreachable",
    }


@pytest.mark.parametrize("ignored", [False, True])
def test_a_load_is_followed_or_ignored(voxels, ignored):
    tf = entire.TransferFunction.points([(0, 0.01), (1, 0.05)])
    volume = entire.Volume(voxels)
    session = entire.Session(volume, ignore_load=ignored)
    truth = entire.Session(volume)
    target = 40 * truth.predict(CAMERA, tf, (640, 480), step=2.0).seconds
    steps = []
    for i in range(60):
        plan = session.plan(CAMERA, tf, (640, 480), target=target)
        seconds = 40 * truth.predict(CAMERA, tf, (640, 480), step=plan.step).seconds
        session.observe(plan, seconds if i < 50 else 1.5 * seconds)
        steps.append(plan.step)
    change = steps[-1] / steps[49]
    assert 0.8 < change < 1.25 if ignored else change > 1.3


def test_little_processor_time_begins_a_load_at_once(voxels):
    tf = entire.TransferFunction.points([(0, 0.01), (1, 0.05)])
    volume = entire.Volume(voxels)
    truth = entire.Session(volume)
    target = 40 * truth.predict(CAMERA, tf, (640, 480), step=2.0).seconds
    steps = {}
    for reported in (False, True):
        session = entire.Session(volume)
        for i in range(52):
            plan = session.plan(CAMERA, tf, (640, 480), target=target)
            steps[i, reported] = plan.step
            usual = 40 * truth.predict(CAMERA, tf, (640, 480), step=plan.step).seconds
            seconds = usual if i < 50 else 2 * usual
            session.observe(plan, seconds, processor_seconds=1.9 * usual if reported else math.nan)
    # Frame 50 is the first slow one, so the plan of frame 51 knows it.
    assert steps[50, True] == steps[50, False]
    assert steps[51, True] > 1.5 * steps[51, False]


def test_the_image_shrinks_where_it_may(voxels, tf):
    session = entire.Session(entire.Volume(voxels))
    session.set_limits(1, 2)
    session.set_max_image_sample_distance(4)
    with pytest.raises(ValueError, match="image weight"):
        session.set_quality(0.0)
    session.set_quality(5.9, 0.97, 1.54, ray_share=0.33)
    session.set_quality(None)
    for _ in range(30):
        plan = session.plan(CAMERA, tf, (640, 480), target=0.005)
        session.observe(plan, drawn(plan))
    assert plan.image_sample_distance > 1
    assert plan.size == tuple(int(n / plan.image_sample_distance) for n in (640, 480))
    session.set_enabled(False)
    plan = session.plan(CAMERA, tf, (640, 480), target=0.005, step=1.5)
    assert (plan.step, plan.size, plan.reason) == (1.5, (640, 480), "off")


def test_a_setting_is_chosen_from_a_list(voxels, tf):
    session = entire.Session(entire.Volume(voxels))
    index, plan = session.choose(CAMERA, tf, (640, 480), 1e-6, [(1, (640, 480)), (2, (640, 480)), (2, (320, 240))])
    assert (index, plan.step, plan.size, plan.image_sample_distance) == (2, 2, (320, 240), 2)
    session.observe(plan, 0.01)
    assert session.history.image_sample_distance[-1] == 2
    # The C library accepts at most 64 settings, Python any number.
    assert session.choose(CAMERA, tf, (640, 480), 1e3, [(1, (640, 480))] * 100)[0] == 0
    for settings, text in (([], "no settings"), ([(1, (-640, 480))], "setting 0: image size"), ([(0, (64, 48))], "step")):
        with pytest.raises(ValueError, match=text):
            session.choose(CAMERA, tf, (640, 480), 0.01, settings)


def test_what_was_learned_is_kept(voxels, tf, tmp_path):
    volume = entire.Volume(voxels)
    first, second = entire.Session(volume), entire.Session(volume)
    for i in range(60):
        plan = first.plan(entire.Camera.arcball(20, 7 * i, 2.5), tf, (640, 480), target=0.01)
        first.observe(plan, drawn(plan, speed=20))
    first.save(tmp_path / "learned")
    # The file is complete, and no temporary file is left beside it. An error names the file that cannot be written.
    assert [p.name for p in tmp_path.iterdir()] == ["learned"]
    assert (tmp_path / "learned").read_bytes() == first.save_state()
    with pytest.raises(OSError, match="nowhere"):
        first.save(tmp_path / "nowhere" / "learned")
    second.load(tmp_path / "learned")
    a, b = (s.predict(CAMERA, tf, (640, 480), step=2.0).seconds for s in (first, second))
    cold = entire.Session(volume).predict(CAMERA, tf, (640, 480), step=2.0).seconds
    assert abs(math.log(a / b)) < 0.2 < abs(math.log(cold / b))
    for damaged in (b"", b"nonsense", first.save_state()[:-3], first.save_state() + b"x"):
        with pytest.raises(ValueError, match="state"):
            second.load_state(damaged)
    first.reset()
    assert len(first.history) == 0


def test_observations_that_say_nothing_are_rejected(voxels, tf):
    session = entire.Session(entire.Volume(voxels))
    plan = session.plan(CAMERA, tf, (64, 64), target=0.01)
    state = session.save_state()
    for seconds in (0, -1, math.nan, math.inf, 1e6):
        with pytest.raises(entire.RejectedObservationError):
            session.observe(plan, seconds)
    assert session.save_state() == state
    session.observe(plan, 0.01)
    with pytest.raises(entire.RejectedObservationError, match="before"):
        session.observe(plan, 0.01)
    other = entire.Session(entire.Volume(voxels))
    with pytest.raises(entire.RejectedObservationError, match="no plan has this id"):
        other.observe(plan, 0.01)
    # A plan belongs to its session, also if another session has a plan with the same number.
    assert other.plan(CAMERA, tf, (64, 64), target=0.01).id == plan.id
    with pytest.raises(entire.RejectedObservationError, match="no plan has this id"):
        other.observe(plan, 0.01)
    assert len(other.history) == 0


def test_sizes_and_ranges_are_sequences(voxels, tf):
    volume = entire.Volume(voxels, [1, 1, 1], range=[0, 255])
    assert volume.range == (0, 255)
    box = [[0, n] for n in voxels.shape]
    assert volume.next(voxels, box).range == volume.range
    nodes = [entire.TransferFunction.nodes([(0, 0), (255, 1)], range=r) for r in ([0, 255], (0, 255))]
    assert np.array_equal(*(each.rgba for each in nodes))
    session = entire.Session(volume)
    sizes = ((64, 48), [64, 48], np.array([64, 48]))
    assert {session.plan(CAMERA, tf, size, 0.01).size for size in sizes[1:]} == {sizes[0]}
    assert len({session.predict(CAMERA, tf, size).seconds for size in sizes}) == 1
    assert session.choose(CAMERA, tf, [64, 48], 1e3, [[1, [64, 48]]])[1].size == sizes[0]
    for size in ([64], [64, 48, 1]):
        with pytest.raises(ValueError, match="length 2"):
            session.plan(CAMERA, tf, size, 0.01)
        with pytest.raises(ValueError, match="length 2"):
            session.choose(CAMERA, tf, (64, 48), 0.01, [(1, size)])
    with pytest.raises(ValueError, match="length 2"):
        entire.Volume(voxels, range=[0, 1, 2])


def test_order_and_ranges_are_said(voxels, tf):
    session = entire.Session()
    with pytest.raises(entire.NotReadyError, match="set_volume"):
        session.plan(CAMERA, tf, (64, 64), 0.01)
    session.set_volume(entire.Volume(voxels))
    with pytest.raises(entire.NotReadyError, match="transfer function"):
        session.plan(CAMERA, None, (64, 64), 0.01)
    for size, target, text in (
        ((0, 64), 0.01, "image size"),
        ((-5, 64), 0.01, "image size"),
        ((64, 64), -1, "target"),
        ((64, 64), math.nan, "target"),
        ((10**12, 64), 0.01, "image size"),
    ):
        with pytest.raises(ValueError, match=text):
            session.plan(CAMERA, tf, size, target)
    with pytest.raises(ValueError, match="shading"):
        session.plan(CAMERA, tf, (64, 64), 0.01, shading="fancy")
    for bad in (
        {"miss_rate": 0}, {"miss_rate": 0.6}, {"tolerance": -1}, {"trust_limit": 0}, {"probe_side": 99},
        {"probe_side": -1}, {"probe_tolerance": 1.5}, {"probe_tolerance": math.nan},
    ):
        with pytest.raises(ValueError, match=next(iter(bad)).split("_")[0]):
            entire.Session(**bad)


def test_a_plan_casts_few_rays_if_more_cannot_change_it(voxels, tf):
    def seconds(**probe):
        return entire.Session(entire.Volume(voxels), **probe).plan(CAMERA, tf, (640, 480), 1e-3).seconds

    # Not even the coarsest step meets the target, so the first probe of 4 x 4 rays is enough.
    assert seconds(probe_tolerance=0.3) == seconds(probe_side=4) != seconds()


def test_adapters_probe_like_the_class():
    source = Path(__file__).parents[2] / "vtk" / "Steering" / "vtkEntireSteeringInternals.cxx"
    text = source.read_text()
    assert f"PROBE_SIDE = {_core.PROBE_SIDE};" in text
    assert f"PROBE_TOLERANCE = {_core.PROBE_TOLERANCE}f;" in text


def test_a_volume_must_be_followed_by_its_transfer_function(voxels, tf):
    session = entire.Session(entire.Volume(voxels))
    session.plan(CAMERA, tf, (64, 64), 0.01)
    session.set_volume(entire.Volume(voxels[:20]))
    with pytest.raises(entire.NotReadyError):
        session.plan(CAMERA, None, (64, 64), 0.01)
    session.plan(CAMERA, tf, (64, 64), 0.01)


def test_saved_states_are_bound_to_renderer_and_clock(voxels, tf):
    def named(renderer, clock):
        session = entire.Session(entire.Volume(voxels))
        session.set_timing_source(renderer, clock)
        return session

    first = named("a renderer", "device")
    for i in range(8):
        plan = first.plan(entire.Camera.arcball(20, 7 * i, 2.5), tf, (640, 480), target=0.01)
        first.observe(plan, 0.02)
    state = first.save_state()
    named("a renderer", "device").load_state(state)
    for other, says in ((named("another", "device"), "renderer"), (named("a renderer", "wall"), "clock")):
        with pytest.raises(entire.ModelError, match=says):
            other.load_state(state)
    with pytest.raises(entire.ModelError, match="renderer"):
        entire.Session(entire.Volume(voxels)).load_state(state)
    with pytest.raises(ValueError, match="256"):
        first.set_timing_source("x" * 257, "")


def test_sessions_know_both_clocks(voxels):
    session = entire.Session(entire.Volume(voxels))
    assert (session.clock, session.model_clock) == (None, None)
    for name in ("cpu", "wall", "device"):
        session.set_timing_source("a renderer", name)
        assert session.clock == name
    session.set_timing_source("a renderer", "a watch")
    assert session.clock is None
    assert entire.Session(model="unshaded-selected").model_clock == "cpu"
    session.set_model("unshaded-selected")
    assert (session.clock, session.model_clock) == (None, "cpu")


def test_a_model_of_another_clock_is_brought_to_this_one(voxels, tf):
    volume = entire.Volume(voxels)
    model = entire.Session(volume, model="unshaded-selected")

    def second(clock):
        """Predicted / measured time of the second frame, if each frame takes a quarter of the model's time."""
        session = entire.Session(volume, model="unshaded-selected")
        session.set_timing_source("a renderer", clock)
        session.set_limits(1, 1)
        takes = 0.25 * model.predict(CAMERA, tf, (640, 480)).seconds
        session.observe(session.plan(CAMERA, tf, (640, 480), target=10.0), takes)
        return session.predict(CAMERA, tf, (640, 480)).seconds / takes

    assert abs(math.log(second("wall"))) < 0.22 < math.log(second("cpu"))


def test_parallel_cameras_agree(voxels, tf):
    volume = entire.Volume(voxels[:, :40, :30], (1, 2, 0.5), origin=(100, -50, 7))
    center, radius = np.array(volume.center), volume.radius
    session = entire.Session(volume)

    def seconds(camera):
        return session.predict(camera, tf, (100, 80)).seconds

    straight = entire.Camera.arcball(0, 0, 2.5, parallel_scale=0.9)
    assert straight.fov is None and straight.parallel_scale == pytest.approx(0.9)
    assert entire.Camera.arcball(0, 0, 2.5).parallel_scale is None
    cameras = [straight]
    # With a parallel projection, the distance of the eye has no effect.
    for distance in (2.5, 40):
        eye = center + distance * radius * np.array((0, 0, 1))
        view = np.eye(4)
        view[:3, 3] = -eye
        cameras += [
            entire.Camera.look_at(volume, eye, parallel_scale=0.9 * radius),
            entire.Camera.view(volume, view, parallel_scale=0.9 * radius),
            entire.Camera.scene(
                volume, view.ravel(), np.eye(4).ravel(), np.eye(3).ravel(), center, 45.0, 0.9 * radius
            ),
        ]
    # OpenGL's matrix: half of the visible height is 0.9 radii, and the width is 100 / 80 of the height.
    clip = np.diag([1 / (0.9 * radius * 1.25), 1 / (0.9 * radius), -0.01, 1.0]) @ view
    cameras.append(entire.Camera.projection(volume, clip))
    times = [seconds(camera) for camera in cameras]
    assert np.allclose(times, times[0], rtol=1e-3), times
    # A distant perspective camera with a narrow field of view sees nearly the same part of the volume.
    angle = 2 * np.degrees(np.arctan(0.9 / 300))
    assert seconds(entire.Camera.arcball(0, 0, 300, angle)) == pytest.approx(times[0], rel=0.02)
    # A change of the scale or of the projection is a jump.
    assert not cameras[4].jumps_from(cameras[1])
    assert entire.Camera.arcball(0, 0, 2.5, parallel_scale=0.5).jumps_from(straight)
    assert entire.Camera.arcball(0, 0, 2.5).jumps_from(straight)
    assert straight.jumps_from(entire.Camera.arcball(0, 0, 2.5))
    for bad in (0, -1, float("nan")):
        with pytest.raises(ValueError, match="parallel scale"):
            entire.Camera.arcball(0, 0, 2.5, parallel_scale=bad)


def test_cameras_agree(voxels, tf):
    volume = entire.Volume(voxels[:, :40, :30], (1, 2, 0.5), origin=(100, -50, 7))
    center, radius = np.array(volume.center), volume.radius
    assert np.allclose(center, np.array((100, -50, 7)) + 0.5 * (np.array(volume.shape) - 1) * volume.spacing)
    eye = center + 2.5 * radius * np.array((0, 0, 1))
    straight = entire.Camera.arcball(0, 0, 2.5)
    at = entire.Camera.look_at(volume, eye)
    view = np.eye(4)
    view[:3, 3] = -eye
    by_matrix = entire.Camera.view(volume, view)
    whole = entire.Camera.scene(volume, view.ravel(), np.eye(4).ravel(), np.eye(3).ravel(), center, 45.0)
    # A volume twice as large at twice the distance looks the same.
    moved = np.diag([2.0, 2, 2, 1])
    far = view.copy()
    far[:3, 3] *= 2
    scaled = entire.Camera.scene(volume, far.ravel(), moved.ravel(), np.eye(3).ravel(), center, 45.0)
    session = entire.Session(volume)
    times = [session.predict(c, tf, (100, 80)).seconds for c in (straight, at, by_matrix, whole, scaled)]
    assert np.allclose(times, times[0], rtol=1e-4)
    assert np.allclose(at.pose, (0, 0, 2.5), atol=1e-3)
    assert not at.jumps_from(straight)
    assert entire.Camera.arcball(0, 60, 2.5).jumps_from(straight)
    assert entire.Camera.arcball(0, 0, 6).jumps_from(straight)
    for bad in (
        lambda: entire.Camera.look_at(volume, center),
        lambda: entire.Camera.look_at(volume, eye, up=(0, 0, 1)),
    ):
        with pytest.raises(ValueError, match="must differ"):
            bad()
    shear = np.eye(4)
    shear[0, 1] = 0.3
    with pytest.raises(ValueError, match="shears"):
        entire.Camera.scene(volume, view.ravel(), shear.ravel(), np.eye(3).ravel(), center, 45.0)
    with pytest.raises(ValueError, match="rotation"):
        entire.Camera.view(volume, 2 * np.eye(4))


def test_transfer_functions_agree():
    points = entire.TransferFunction.points([(0, 0), (0.5, 0.25), (1, 1)])
    nodes = entire.TransferFunction.nodes([(10, 0), (15, 0.25), (20, 1)], range=(10, 20))
    table = entire.TransferFunction.table(points.rgba[:, 3])
    arrays = entire.TransferFunction.points(np.array([(0, 0), (0.5, 0.25), (1, 1)]))
    assert np.array_equal(arrays.rgba, points.rgba)
    lists = entire.TransferFunction.nodes([[10, 0], [15, 0.25, 0.5, 0], [20, 1]], [[0, 1, 0, 0]], range=(10, 20))
    assert np.array_equal(lists.rgba[:, 3], nodes.rgba[:, 3])
    assert points.rgba.shape == (256, 4)
    assert points.rgba.dtype == np.float32
    assert np.allclose(points.rgba[:, 3], nodes.rgba[:, 3], atol=1e-6)
    assert np.allclose(points.rgba[:, 3], table.rgba[:, 3], atol=1e-6)
    s = np.arange(256) / 255
    lobes = entire.TransferFunction.lobes([(0.3, 0.02, 0.4), (0.7, 0.05, 0.2)])
    expected = 0.4 * np.exp(-((s - 0.3) ** 2) / 0.02) + 0.2 * np.exp(-((s - 0.7) ** 2) / 0.05)
    assert np.allclose(lobes.rgba[:, 3], expected, atol=1e-6)
    for bad, text in (
        (lambda: entire.TransferFunction.lobes([(0.5, 0, 1)]), "lobe 0"),
        (lambda: entire.TransferFunction.points([(0.5, 1), (0.2, 1)]), "point"),
        (lambda: entire.TransferFunction.points([(0, 1), (0.2, 1, 1)]), "point 1 has 3 numbers"),
        (lambda: entire.TransferFunction.nodes([(0, 1)], [(0, 1)], range=(0, 1)), "color node 0 has 2 numbers"),
        (lambda: entire.TransferFunction.table(np.zeros((5, 3))), "shape"),
        (lambda: entire.TransferFunction.table([0.5]), "at least 2"),
        (lambda: entire.TransferFunction.points([(0, 1)], unit_distance=1, unit_length=1), "both"),
        (lambda: entire.TransferFunction.points([(0, 1)], unit_length=-1), "unit_length is -1; .* positive"),
    ):
        with pytest.raises(ValueError, match=text):
            bad()


def test_opacity_of_a_length_in_space_follows_the_spacing(voxels):
    volume = entire.Volume(voxels, (2, 2, 2))
    steps = entire.TransferFunction.points([(0, 0), (1, 0.2)], unit_distance=2)
    space = entire.TransferFunction.points([(0, 0), (1, 0.2)], unit_length=4)
    orbit = [(0, a, 2) for a in range(0, 180, 30)]
    assert np.array_equal(
        entire.predict(volume, orbit, steps, (64, 64)), entire.predict(volume, orbit, space, (64, 64))
    )


def test_the_machines_model(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    with pytest.raises(FileNotFoundError, match=r"entire calibrate --shade local`, .* \(entire\.models\(\)"):
        entire.Model.machine("local")
    with pytest.raises(ValueError, match="none, local, scatter or local-scatter"):
        entire.Model.machine("phong")
    (tmp_path / "entire").mkdir()
    shipped = entire.Model("local-selected")
    shipped.save(tmp_path / "entire" / "machine-local.safetensors")
    found = entire.Model.machine("local")
    assert isinstance(found, entire.Model) and found.to_bytes() == shipped.to_bytes()
    with pytest.raises(FileNotFoundError):
        entire.Model.machine()


def test_models_by_name_path_and_bytes(voxels, tf, tmp_path):
    names = entire.models()
    assert {"unshaded-selected", "local-selected", "scatter-selected"} <= set(names)
    model = entire.Model("unshaded-selected")
    model.save(tmp_path / "copy.safetensors")
    orbit = [(0, a, 2) for a in range(0, 180, 30)]
    times = [
        entire.predict(voxels, orbit, tf, (64, 64), model=m)
        for m in (
            "unshaded-selected",
            model,
            tmp_path / "copy.safetensors",
            str(tmp_path / "copy.safetensors"),
            model.to_bytes(),
        )
    ]
    assert all(np.array_equal(times[0], t) for t in times)
    assert model.predicts
    assert not np.array_equal(times[0], entire.predict(voxels, orbit, tf, (64, 64)))
    with pytest.raises(FileNotFoundError, match="unshaded-selected"):
        entire.Model("no such model")
    with pytest.raises(entire.ModelError):
        entire.Model(b"nothing")
    with pytest.raises(entire.ModelError):
        entire.Model(model.to_bytes()[:-10])
    # The error about a damaged file names the file.
    (tmp_path / "damaged.safetensors").write_bytes(model.to_bytes()[:-10])
    with pytest.raises(entire.ModelError, match="damaged.safetensors: "):
        entire.Model(tmp_path / "damaged.safetensors")
    with pytest.raises(ValueError, match="damaged.safetensors: "):
        entire.Session().load(tmp_path / "damaged.safetensors")
    encoder = entire.Model("volumenet-64f2")
    assert encoder.encodes
    features = encoder.encode(entire.Volume(voxels))
    assert features.shape == (2,)
    assert np.isfinite(features).all()
    with pytest.raises(entire.ModelError, match="no prediction network"):
        entire.Session(model=encoder)
    with pytest.raises(entire.ModelError, match="encoder"):
        model.encode(entire.Volume(voxels))


def recording(volume, *arguments, **options):
    """A session that is switched off and records frames that were timed earlier."""
    session = entire.Session(volume)
    session.set_enabled(False)
    session.record(*arguments, **options)
    return session


def test_calibration_finds_the_renderer(voxels, tf):
    volume = entire.Volume(voxels)
    rng = np.random.default_rng(5)
    truth = entire.Session(volume)

    def renderer(camera, size, step):
        # Another machine: 40 times the untrained model's seconds and a fixed cost per frame.
        return 2e-3 + 40 * truth.predict(camera, tf, size, step=step).seconds

    session = recording(volume)
    with pytest.raises(entire.NotReadyError, match="at least 8"):
        session.calibrate()
    # The first frame of a session is not recorded.
    for _ in range(61):
        camera = entire.Camera.arcball(*(float(v) for v in rng.uniform((-80, 0, 1.2), (80, 360, 4))))
        size, step = (int(rng.integers(100, 800)), int(rng.integers(100, 800))), float(2 ** rng.uniform(0, 3))
        plan = session.plan(camera, tf, size, target=1.0, step=step)
        assert (plan.reason, plan.step) == ("off", pytest.approx(step))
        session.observe(plan, renderer(camera, size, step))
    assert session.recorded == 60
    made = session.calibrate()
    assert made.median_error < 0.02
    assert made.held_out == "stretches of time"
    fitted = entire.Session(volume, model=made.model)
    for _ in range(20):
        camera = entire.Camera.arcball(*(float(v) for v in rng.uniform((-80, 0, 1.2), (80, 360, 4))))
        assert fitted.predict(camera, tf, (300, 200)).seconds == pytest.approx(
            renderer(camera, (300, 200), 1.0), rel=0.05
        )


def test_a_session_learns_its_renderer_without_being_left(voxels, tf):
    session = entire.Session(entire.Volume(voxels))
    assert session.recorded is None
    with pytest.raises(entire.NotReadyError, match="record"):
        session.calibrate()
    with pytest.raises(entire.NotReadyError, match="record"):
        session.record_picture(0, 1, 1, 0.01, 0)
    for frames in (7, -1):
        with pytest.raises(ValueError, match="65536"):
            session.record(frames)
    session.record(80)
    rng = np.random.default_rng(3)

    def renderer(size):
        return 1e-3 + 4e-8 * size[0] * size[1]

    for i in range(120):
        camera = entire.Camera.arcball(20, 7 * i % 360, 2.5)
        size = tuple(int(n) for n in rng.integers(64, 500, 2))
        session.observe(session.plan(camera, tf, size, target=0.5), renderer(size))
    assert session.recorded == 80
    session.set_timing_source("pixels", "wall")
    made = session.calibrate()
    assert made.frames == 80 and made.median_error < 0.05 and made.upper_factor < 1.3
    assert made.model.metadata["entire.clock"] == "wall"
    session.set_model(made.model)
    assert len(session.history) == 0
    expected = session.predict(CAMERA, tf, (333, 222)).seconds
    assert expected == pytest.approx(renderer((333, 222)), rel=0.1)
    again = entire.Session(entire.Volume(voxels), model=made.model.to_bytes())
    assert again.predict(CAMERA, tf, (333, 222)).seconds == expected
    with pytest.raises(entire.ModelError, match="analytic"):
        session.record(model="volumenet-64f2")


def test_a_shipped_model_is_taken_to_a_renderer(voxels, tf):
    session = recording(entire.Volume(voxels), 50, model="unshaded-selected")
    session.set_timing_source("pixels", "wall")
    for i in range(31):
        camera = entire.Camera.arcball(20, 11 * i % 360, 2 + i % 3)
        size = (100 + 17 * i, 200)
        plan = session.plan(camera, tf, size, target=1.0)
        session.observe(plan, 1e-3 + 4e-8 * size[0] * size[1])
    made = session.calibrate()
    assert [name for name, _ in made.model.inputs] == ["scene_features"]
    assert made.median_error < 0.15
    assert made.model.metadata["entire.renderer"] == "pixels"


def test_a_history_is_shown(voxels, tf):
    import xml.etree.ElementTree as tree

    session = entire.Session(entire.Volume(voxels))
    assert "no frame" in session._repr_html_()
    for i in range(50):
        plan = session.plan(CAMERA, tf, (640, 480), target=0.01)
        session.observe(plan, drawn(plan))
    root = tree.fromstring(session.history.svg())
    assert root.tag.endswith("svg")
    assert len([e for e in root.iter() if e.tag.endswith("path")]) == 4
    assert "50 frames" in session._repr_html_()
    with pytest.raises(AttributeError, match="nothing"):
        session.history.nothing
