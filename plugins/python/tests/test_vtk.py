# SPDX-License-Identifier: MIT OR Apache-2.0
"""Steering of the VTK from PyPI, checked by pictures, settings and times."""

import gc
import json
import math
import warnings
import weakref

import numpy as np
import pytest

pytest.importorskip("vtkmodules")

import entire
import entire.vtk
from entire.vtk import _steering
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkCommonDataModel import vtkDataObject, vtkPlane, vtkPlaneCollection
from vtkmodules.vtkCommonExecutionModel import vtkTrivialProducer
from vtkmodules.vtkRenderingCore import vtkRenderer, vtkRenderWindowInteractor, vtkVolume

from scenes import (
    COLOR,
    MAPPERS,
    OPAQUE,
    TRANSPARENT,
    View,
    add_volume,
    color_function,
    image_data,
    one_volume,
    opacity_function,
    settings,
)

KINDS = ["gpu", "fixed", "smart"]


def mean_time(view, frames=6):
    """Processor seconds of a frame at full quality."""
    import time

    view.draw(3)
    before = time.process_time()
    view.draw(frames)
    return (time.process_time() - before) / frames


@pytest.mark.parametrize("kind", KINDS)
def test_frames_are_held(voxels, kind):
    view = View((300, 300))
    volume = add_volume(view.renderer, voxels, kind)
    target = 0.4 * mean_time(view)
    before, mapper = settings(volume.GetMapper()), volume.GetMapper()
    steering = entire.vtk.hold(view.renderer, volume, target, clock="cpu")
    own = settings(volume.GetMapper())
    view.draw(40)
    assert steering.status == ""
    assert steering.steered_frames >= 39
    assert steering.fallback_frames == 0
    leaf = steering.leaves[0]
    finest = leaf._finest * leaf._grid.reference
    assert leaf.sample_distance > 1.01 * finest or leaf.image_sample_distance > 1.0
    history = steering.history
    # Wide limits, which any machine meets: they show that frames are coarsened to about the right extent.
    late = np.asarray(history.measured)[20:] / target
    assert 0.3 < np.median(late) < 1.6
    # Between frames the mapper has the application's settings, or those of the smart mapper's replacement.
    assert settings(volume.GetMapper()) == own
    assert own == before or kind == "smart"
    steering.detach()
    assert volume.GetMapper() is mapper
    assert settings(mapper) == before


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("spacing", [(1, 1, 1), (0.5, 1.0, 2.0)])
def test_still_frames_are_vtks_byte_for_byte(voxels, kind, spacing):
    view, volume = one_volume(voxels[:, :40], kind, spacing=spacing)
    view.draw(2)
    view.orbit(45, 100)
    view.window.Render()
    plain = view.pixels()
    assert plain.std() > 5
    steering = entire.vtk.hold(view.renderer, volume, 1e-4)
    view.draw(5)
    coarse = view.pixels()
    view.orbit(45, 100)
    with steering.still():
        view.window.Render()
    assert steering.reason == "still"
    assert np.array_equal(view.pixels(), plain)
    view.window.Render()
    assert steering.reason != "still"
    assert not np.array_equal(view.pixels(), plain)
    assert not np.array_equal(coarse, plain)
    # With steering disabled, the picture is unchanged too.
    steering.enabled = False
    view.window.Render()
    assert np.array_equal(view.pixels(), plain)
    steering.detach()
    view.window.Render()
    assert np.array_equal(view.pixels(), plain)


@pytest.mark.parametrize(("spacing", "scale"), [(1.0, 1.0), (0.01, 1.0), (5.0, 1.0), (0.5, 2.0)])
def test_full_quality_is_that_of_a_mapper_that_adjusts_by_itself(voxels, spacing, scale):
    view, volume = one_volume(voxels[:, :40], "gpu", spacing=(spacing,) * 3)
    volume.SetScale(scale)
    volume.GetMapper().SetAutoAdjustSampleDistances(1)
    volume.GetProperty().SetScalarOpacityUnitDistance(spacing)
    away = 110 * spacing * scale
    view.draw(3, away)
    view.orbit(30, away)
    view.window.Render()
    plain = view.pixels().astype(float)
    assert plain.std() > 5
    steering = entire.vtk.hold(view.renderer, volume, 100.0)
    view.draw(5, away)
    view.orbit(30, away)
    view.window.Render()
    assert steering.reason not in ("still", "fallback")
    assert np.abs(view.pixels() - plain).mean() < 0.5
    assert steering.leaves[0].sample_distance == pytest.approx(spacing * scale, rel=1e-3)


def test_the_windows_rate_decides_where_there_is_an_interactor(voxels):
    view, volume = one_volume(voxels)
    interactor = vtkRenderWindowInteractor()
    interactor.SetRenderWindow(view.window)
    steering = entire.vtk.hold(view.renderer, volume, 0.001)
    view.window.SetDesiredUpdateRate(1e-4)
    view.draw(2)
    assert steering.reason == "still"
    view.window.SetDesiredUpdateRate(15)
    view.draw(2)
    assert steering.reason not in ("still", "fallback")
    steering.seconds = None
    view.draw(2)
    assert steering.history.target[-1] == pytest.approx(1 / 15, rel=0.9)
    steering.always = True
    view.window.SetDesiredUpdateRate(1e-4)
    steering.seconds = 0.001
    view.draw(1)
    assert steering.reason != "still"


def test_several_volumes_share_the_time(voxels):
    view = View((300, 300))
    left, right = (
        add_volume(view.renderer, voxels),
        add_volume(view.renderer, voxels[:, :24], points=TRANSPARENT),
    )
    left.SetPosition(-25, 0, 0)
    right.SetPosition(25, 0, 0)
    target = 0.4 * mean_time(view)
    steering = entire.vtk.hold(view.renderer, seconds=target, clock="cpu")
    view.draw(40)
    assert len(steering.leaves) == 2
    assert all(leaf.reason not in ("", "still", "fallback") for leaf in steering.leaves)
    steps = [leaf.sample_distance * leaf.image_sample_distance**2 for leaf in steering.leaves]
    assert min(steps) > 1
    # A volume that is added later is steered, a removed one gets its settings back.
    later = add_volume(view.renderer, voxels[:16])
    view.draw(3)
    assert len(steering.leaves) == 3
    view.renderer.RemoveVolume(left)
    view.draw(2)
    assert len(steering.leaves) == 2
    assert settings(left.GetMapper())[0] == 1.0
    assert not left.GetMapper().HasObserver("VolumeMapperRenderStartEvent")
    assert later in [leaf.volume for leaf in steering.leaves]
    # A deleted volume is forgotten: another may get its address.
    address = later.__this__
    view.renderer.RemoveVolume(later)
    del later
    gc.collect()
    view.draw(1)
    assert len(steering.leaves) == 1
    assert address not in _steering._held


def test_scene_changes_are_followed(voxels):
    view, volume = one_volume(voxels)
    steering = entire.vtk.hold(view.renderer, volume, 0.004)
    view.draw(5)
    leaf = steering.leaves[0]
    first = leaf.volume_time
    # Steering continues after changes of the input, cropping, clipping, shading, the volume's matrix, the projection,
    # the blend mode and the mapper.
    volume.GetMapper().SetInputData(image_data(voxels[:30]))
    view.draw(3)
    assert leaf.volume_time != first
    assert leaf._grid.volume.shape == (48, 48, 30)
    mapper = volume.GetMapper()
    mapper.CroppingOn()
    mapper.SetCroppingRegionPlanes(-10, 10, -10, 10, -5, 5)
    mapper.SetCroppingRegionFlagsToSubVolume()
    view.draw(2)
    assert leaf._grid.volume.shape == (22, 22, 12)
    mapper.CroppingOff()
    planes, plane = vtkPlaneCollection(), vtkPlane()
    plane.SetNormal(1, 0, 0)
    planes.AddItem(plane)
    mapper.SetClippingPlanes(planes)
    volume.GetProperty().ShadeOn()
    volume.SetPosition(3, 4, 5)
    volume.SetScale(1, 1, -1)
    view.renderer.GetActiveCamera().ParallelProjectionOn()
    view.draw(3)
    assert steering.status == ""
    assert leaf._shading == "local"
    view.renderer.GetActiveCamera().ParallelProjectionOff()
    mapper.SetBlendModeToMaximumIntensity()
    view.draw(2)
    assert leaf._termination == 1.0
    other = MAPPERS["fixed"]()
    other.SetInputData(image_data(voxels))
    volume.SetMapper(other)
    # Steering continues with another mapper after a reset, too.
    steering.reset()
    steered = steering.steered_frames
    view.draw(3)
    assert steering.status == ""
    assert steering.steered_frames > steered
    assert not mapper.HasObserver("VolumeMapperRenderStartEvent")
    # A setting that the application makes meanwhile is kept.
    other.SetAutoAdjustSampleDistances(0)
    other.SetSampleDistance(0.5)
    view.draw(2)
    assert other.GetSampleDistance() == 0.5
    assert steering.fallback_frames == 0
    values = image_data(voxels)
    values.GetPointData().GetScalars().SetName("dose")
    other.SetInputData(values)
    other.SetScalarModeToUsePointFieldData()
    other.SelectScalarArray("dose")
    view.draw(2)
    assert steering.status == ""
    # The transfer function is read again after a changed point, but not after changed lighting.
    leaf, prop = steering.leaves[0], volume.GetProperty()
    read = leaf._tf
    prop.SetAmbient(0.4)
    view.draw(1)
    assert leaf._tf is read
    prop.GetScalarOpacity().AddPoint(100, 0.5)
    view.draw(1)
    assert leaf._tf is not read


@pytest.mark.parametrize("kind", ["gpu", "fixed"])
def test_only_other_functions_are_new(voxels, kind):
    view, volume = one_volume(voxels, kind)
    steering = entire.vtk.hold(view.renderer, volume, 0.004)
    view.draw(2)
    leaf, prop = steering.leaves[0], volume.GetProperty()
    opacity, color = prop.GetScalarOpacity(), prop.GetRGBTransferFunction(0)

    def rebuilt():
        opacity.RemoveAllPoints()
        for at, value in OPAQUE:
            opacity.AddPoint(at, value)

    def is_new(change):
        read = leaf._tf
        change()
        view.draw(1)
        assert steering.status == ""
        # The key of the current functions is stored, so that they are not read again in the next frame.
        assert leaf._tf_key == entire.vtk._scene.transfer_key(prop)
        return leaf._tf is not read

    for same in (
        opacity.Modified,
        color.Modified,
        rebuilt,
        lambda: prop.SetScalarOpacity(opacity_function(OPAQUE)),
        lambda: prop.SetColor(color_function(COLOR)),
        lambda: prop.SetAmbient(0.37),
    ):
        assert not is_new(same)
    for other in (
        lambda: prop.GetScalarOpacity().AddPoint(120, 0.7, 0.9, 0.8),
        lambda: prop.GetScalarOpacity().ClampingOff(),
        lambda: prop.GetScalarOpacity().UseLogScaleOn(),
        lambda: prop.GetRGBTransferFunction(0).AddRGBPoint(100, 0.2, 0.9, 0.2),
        lambda: prop.SetScalarOpacityUnitDistance(3.5),
        lambda: prop.SetScalarOpacity(opacity_function(TRANSPARENT)),
        # With another volume, the transfer function must be set in the session again.
        lambda: volume.GetMapper().SetInputData(image_data(voxels[:30])),
    ):
        assert is_new(other)


@pytest.mark.parametrize("kind", ["gpu", "fixed"])
def test_voxels_that_change_in_place_are_read_again(voxels, kind):
    view, volume = one_volume(voxels, kind)
    steering = entire.vtk.hold(view.renderer, volume, 0.004)
    image = volume.GetMapper().GetInput()
    scalars = image.GetPointData().GetScalars()
    view.draw(2)
    leaf = steering.leaves[0]
    for value, changed in ((90, image), (70, scalars)):
        read = leaf._grid
        view.draw(1, start=40)
        assert leaf._grid is read
        vtk_to_numpy(scalars)[:] = np.arange(voxels.size) % value
        changed.Modified()
        view.draw(1)
        assert leaf._grid is not read
        read = leaf._grid
        view.draw(1)
        assert leaf._grid is read
    # VTK caches the scalars' range until Modified() is called on them.
    assert leaf._grid.range == (0.0, 69.0)
    assert steering.status == ""


@pytest.mark.parametrize("kind", ["gpu", "fixed"])
def test_a_producer_that_exchanges_its_output_is_followed(voxels, kind):
    view, volume = one_volume(voxels, kind)
    mapper, producer = volume.GetMapper(), vtkTrivialProducer()
    other = image_data(voxels[:30])
    producer.SetOutput(image_data(voxels))
    mapper.SetInputConnection(producer.GetOutputPort())
    steering = entire.vtk.hold(view.renderer, volume, 0.004)
    view.draw(3)
    leaf, told = steering.leaves[0], mapper.GetMTime()
    assert leaf._grid.volume.shape == (48, 48, 48)
    # The producer's change does not change the MTime of the mapper.
    producer.SetOutput(other)
    assert mapper.GetMTime() == told
    view.draw(2)
    assert steering.status == ""
    assert leaf._grid.volume.shape == (48, 48, 30)


@pytest.mark.parametrize("kind", ["gpu", "fixed"])
def test_a_mappers_time_is_that_of_finished_work(voxels, kind):
    view, volume = one_volume(voxels, kind)
    view.draw(1)
    waits, wait = [], view.window.WaitForCompletion
    view.window.__dict__["WaitForCompletion"] = lambda: (waits.append(0), wait())
    try:
        # Calibration frames and steered frames wait for the graphics device if the mapper is the GPU mapper.
        entire.vtk.calibrate(view.renderer, volume, frames=10)
        # Fourteen frames before the comparison of pictures (two of them begin an image size), then four scenes at
        # twelve settings, each drawn twice.
        assert len(waits) == (2 * (14 + 4 * 12 * 2) if kind == "gpu" else 0)
        waits.clear()
        entire.vtk.hold(view.renderer, volume, 100.0)
        view.draw(3)
        assert len(waits) == (2 * 3 if kind == "gpu" else 0)
    finally:
        del view.window.__dict__["WaitForCompletion"]


def test_what_the_application_sets_within_a_frame_is_kept(voxels):
    view, volume = one_volume(voxels)
    mapper = volume.GetMapper()
    steering = entire.vtk.hold(view.renderer, volume, 0.002)
    mapper.AddObserver("VolumeMapperRenderStartEvent", lambda m, _: m.SetSampleDistance(0.75), -2.0)
    view.draw(3)
    assert mapper.GetSampleDistance() == 0.75
    assert mapper.GetImageSampleDistance() == 1.0
    steering.detach()


def test_a_frame_that_cannot_be_predicted_is_vtks(voxels):
    view, volume = one_volume(voxels)
    volume.GetMapper().GetInput().GetPointData().SetScalars(None)
    steering = entire.vtk.hold(view.renderer, volume, 0.002)
    view.draw(1)
    assert steering.reason in ("fallback", "")
    sheared = View()
    volume = add_volume(sheared.renderer, voxels)
    from vtkmodules.vtkCommonMath import vtkMatrix4x4

    matrix = vtkMatrix4x4()
    matrix.SetElement(0, 1, 0.4)
    volume.SetUserMatrix(matrix)
    sheared.draw(1)
    plain = sheared.pixels()
    steering = entire.vtk.hold(sheared.renderer, volume, 0.002)
    sheared.draw(1)
    assert steering.reason == "fallback"
    assert "shears" in steering.why
    assert steering.fallback_frames == 1
    assert np.array_equal(sheared.pixels(), plain)
    assert math.isnan(steering.predicted)
    volume.SetUserMatrix(None)
    sheared.draw(2)
    assert steering.status == ""


@pytest.mark.parametrize(
    ("module", "name", "text"),
    [
        ("vtkRenderingVolume", "vtkMultiBlockVolumeMapper", "volume of its own"),
        ("vtkRenderingVolume", "vtkUnstructuredGridVolumeRayCastMapper", "resample"),
    ],
)
def test_mappers_that_cannot_be_steered_say_why(module, name, text):
    import importlib

    for candidate in (module, module + "OpenGL2"):
        found = getattr(importlib.import_module("vtkmodules." + candidate), name, None)
        if found is not None:
            break
    renderer, volume = vtkRenderer(), vtkVolume()
    volume.SetMapper(found())
    renderer.AddVolume(volume)
    with pytest.raises(entire.CannotSteer, match=text):
        entire.vtk.hold(renderer, volume, 0.01)


def test_misuse_is_said(voxels):
    view, volume = one_volume(voxels)
    for arguments, text in (
        ((None, volume, 0.1), "vtkRenderer"),
        (("a renderer", volume, 0.1), "vtkRenderer"),
        ((vtkRenderer(),), "no volume"),
        ((view.renderer, volume.GetMapper(), 0.1), "not its mapper"),
        ((view.renderer, volume, 0.0), "seconds is 0"),
        ((view.renderer, volume, math.nan), "seconds is nan"),
    ):
        with pytest.raises(ValueError, match=text):
            entire.vtk.hold(*arguments)
    for option in ({"clock": "sun"}, {"coarsest": 0}, {"coarsest_image": 0.5}, {"tolerance": -1}):
        with pytest.raises(ValueError, match=next(iter(option))):
            entire.vtk.hold(view.renderer, volume, 0.1, **option)
    assert not volume.GetMapper().HasObserver("VolumeMapperRenderStartEvent")
    for arguments, text in (
        ((1 / 30,), "seconds=0.03"),
        ((np.float32(1 / 30),), "seconds=0.03"),
        (([],), "empty list"),
        (([1],), "1 is not a volume"),
        ((vtkVolume(), 0.1), "not in this renderer"),
    ):
        with pytest.raises(ValueError, match=text):
            entire.vtk.hold(view.renderer, *arguments)
    for option in ({"finest": 0}, {"finest": math.nan}, {"still_rate": math.nan}):
        with pytest.raises(ValueError, match=next(iter(option))):
            entire.vtk.hold(view.renderer, volume, 0.1, **option)
    with pytest.raises(ValueError, match="no window"):
        entire.vtk.calibrate(vtkRenderer())
    bare = vtkVolume()
    view.renderer.AddVolume(bare)
    with pytest.raises(ValueError, match="no mapper"):
        entire.vtk.hold(view.renderer, bare, 0.1)


def test_the_scene_keeps_a_steering_alive_and_not_the_other_way_round(voxels):
    view, volume = one_volume(voxels, "smart")
    gone = weakref.ref(entire.vtk.hold(view.renderer, volume, 0.001))
    gc.collect()
    view.draw(2)
    assert gone().steered_frames == 2
    del view, volume
    gc.collect()
    assert gone() is None


def test_calibration_serves_the_first_frame(voxels, tmp_path):
    view, volume = one_volume(voxels)
    view.draw(2)
    before, camera = settings(volume.GetMapper()), view.renderer.GetActiveCamera().GetPosition()
    unit = volume.GetProperty().GetScalarOpacityUnitDistance(0)
    plain = view.pixels()
    model = entire.vtk.calibrate(view.renderer, volume, frames=25, clock="cpu", pictures=3)
    assert settings(volume.GetMapper()) == before
    assert view.renderer.GetActiveCamera().GetPosition() == camera
    assert volume.GetProperty().GetScalarOpacityUnitDistance(0) == unit
    assert np.array_equal(view.pixels(), plain)
    assert model.predicts
    assert model.metadata["entire.clock"] == "cpu"
    assert model.metadata["entire.renderer"] == volume.GetMapper().GetClassName()
    steering = entire.vtk.hold(view.renderer, volume, 0.01, model=model, clock="cpu")
    with steering.still():
        view.draw(1)
    cold = entire.vtk.hold(view.renderer, volume, 0.01, clock="cpu")
    view.draw(12)
    full = np.median(cold.history.measured[3:] * cold.history.step[3:])
    assert full > 0
    steering = entire.vtk.hold(view.renderer, volume, 0.01, model=model, clock="cpu")
    with steering.still():
        view.draw(1, start=30)
        assert 0.2 < steering.predicted / steering.measured < 5
    steering.save(tmp_path / "state")
    again = entire.vtk.hold(view.renderer, volume, 0.01, model=model, clock="cpu")
    again.load(tmp_path / "state")
    with pytest.raises(ValueError, match="test_vtk.py: .*state"):
        again.load(__file__)
    with pytest.raises(ValueError, match="at least 10"):
        entire.vtk.calibrate(view.renderer, volume, frames=3)
    with pytest.raises(ValueError, match="at least 3 scenes"):
        entire.vtk.calibrate(view.renderer, volume, pictures=2)
    with pytest.raises(ValueError, match="clock"):
        entire.vtk.calibrate(view.renderer, volume, clock="sun")
    volume.VisibilityOff()
    with pytest.raises(ValueError, match="not drawn"):
        entire.vtk.calibrate(view.renderer, volume, frames=10)


@pytest.mark.parametrize(("kind", "law"), [("gpu", (8.5, 1.22, 0.78, 0.15)), ("fixed", (5.9, 0.97, 1.54, 0.33))])
def test_without_a_model_steering_goes_by_the_mappers_built_in_law(voxels, kind, law):
    view, volume = one_volume(voxels, kind)
    steering = entire.vtk.hold(view.renderer, volume, 1e-6, clock="cpu")
    view.draw(3)
    assert steering._leaf._session.quality == pytest.approx(law)
    assert steering.image_sample_distance > 1


@pytest.mark.parametrize("kind", ["gpu", "fixed"])
def test_calibration_compares_pictures_and_steering_goes_by_them(voxels, kind):
    view, volume = one_volume(voxels, kind)
    view.draw(1)
    seen = []

    def error(picture, full):
        assert picture.shape == full.shape and picture.dtype == np.uint8
        seen.append(entire.vtk.rmse(picture, full))
        return seen[-1]

    model = entire.vtk.calibrate(view.renderer, volume, frames=10, clock="cpu", pictures=3, picture_error=error)
    assert len(seen) == 36 and seen[0] == seen[12] == seen[24] == 0 and max(seen) > 0.1
    stated = json.loads(model.metadata["entire.quality"])
    law = tuple(stated[name] for name in ("image_weight", "step_exponent", "image_exponent", "ray_share"))
    session = entire.Session(model=model)
    assert session.quality == pytest.approx(law)
    session.set_timing_source("another renderer", "cpu")
    assert session.quality is None
    session.set_quality(3.0)
    assert session.quality == (3.0, 1.0, 1.0, 0.0)
    steering = entire.vtk.hold(view.renderer, volume, 1e-6, model=model, clock="cpu")
    view.draw(3)
    assert steering._leaf._session.quality == pytest.approx(law)
    plain = entire.vtk.calibrate(view.renderer, volume, frames=10, clock="cpu", pictures=0)
    assert "entire.quality" not in plain.metadata


def test_a_model_of_another_clock_is_said_once(voxels):
    view, volume = one_volume(voxels)
    said = r"of the cpu clock.*by the wall clock.*first frames.*--clock wall.*entire\.vtk\.calibrate.*'wall'"
    with pytest.warns(UserWarning, match=said) as warned:
        steering = entire.vtk.hold(view.renderer, volume, 0.004, model="unshaded-selected")
        view.draw(3)
        steering.reset()
        view.draw(3)
    assert len([each for each in warned if "clock" in str(each.message)]) == 1
    assert warned[0].filename.endswith("test_vtk.py")
    assert (steering.clock, steering.model_clock) == ("wall", "cpu")
    assert "wall clock, model of the cpu clock" in repr(steering)
    assert steering.status == ""
    session = steering.leaves[0].session
    assert (session.clock, session.model_clock) == ("wall", "cpu")
    # A model of this clock, or without a clock, causes no warning.
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*clock")
        same = entire.vtk.hold(view.renderer, volume, 0.004, model="unshaded-selected", clock="cpu")
        assert (same.clock, same.model_clock) == ("cpu", "cpu")
        none = entire.vtk.hold(view.renderer, volume, 0.004)
        assert (none.clock, none.model_clock) == ("wall", None)
        assert "wall clock" in repr(none)
        # If the warning is raised as an error, hold() leaves the scene unchanged.
        with pytest.raises(UserWarning, match="cpu clock"):
            entire.vtk.hold(view.renderer, volume, 0.004, model="unshaded-selected")
    assert none.leaves


def test_what_was_learned_belongs_to_mapper_and_clock(voxels, tmp_path):
    view, volume = one_volume(voxels)
    steering = entire.vtk.hold(view.renderer, volume, 0.004)
    view.draw(4)
    leaf, state = steering.leaves[0], tmp_path / "state"
    learned = leaf.session
    steering.save(state)
    steering.load(state)
    # A new mapper of the same class continues with the learned session, one of another class starts a new one.
    for kind, same in (("gpu", True), ("fixed", False)):
        mapper = MAPPERS[kind]()
        mapper.SetInputData(image_data(voxels))
        volume.SetMapper(mapper)
        view.draw(2)
        assert steering.status == ""
        assert (leaf.session is learned) == same
    # The state given to load() belongs to the GPU mapper; the fixed-point mapper refuses it, and a note says so.
    assert any("renderer" in note for note in steering.notes)
    with pytest.raises(entire.ModelError, match="renderer"):
        steering.load(state)
    timed = entire.vtk.hold(view.renderer, add_volume(view.renderer, voxels), 0.004, clock="cpu")
    with pytest.raises(entire.ModelError, match="clock"):
        timed.load(state)
    # Of several volumes, those to which the state belongs load it.
    timed.detach()
    both = entire.vtk.hold(view.renderer, seconds=0.004)
    assert len(both.leaves) == 2
    both.load(state)
    view.draw(2)
    assert all(each.status == "" for each in both.leaves)


def test_the_overlay_never_enters_still_frames(voxels):
    view, volume = one_volume(voxels)
    view.draw(2)
    plain = view.pixels()
    steering = entire.vtk.hold(view.renderer, volume, 0.002, overlay=True)
    with steering.still():
        view.draw(2)
    assert np.array_equal(view.pixels(), plain)
    view.draw(2)
    with_text = view.pixels()
    steering.detach()
    view.draw(2)
    assert np.array_equal(view.pixels(), plain)
    assert not np.array_equal(with_text[:30], plain[:30])


def test_time_outside_of_the_window_counts(voxels):
    view, volume = one_volume(voxels)
    steering = entire.vtk.hold(view.renderer, volume, 0.1, clock="cpu")
    view.draw(8)
    free = steering.history.target[-1]
    for _ in range(5):
        steering.also(0.03)
    view.draw(1)
    assert steering.history.target[-1] == pytest.approx(free - 0.03, abs=0.01)
    with pytest.raises(ValueError, match="not negative"):
        steering.also(-1)


@pytest.mark.parametrize("kind", ["gpu", "fixed"])
def test_picking_is_left_alone(voxels, kind):
    from vtkmodules.vtkRenderingCore import vtkHardwareSelector

    view, volume = one_volume(voxels, kind)
    mapper = volume.GetMapper()
    # No machine meets this target.
    steering = entire.vtk.hold(view.renderer, volume, 1e-6)
    view.draw(4)
    assert steering.sample_distance > 1.5
    session, own = steering.leaves[0].session, settings(mapper)
    told, seen = [], []
    steering.on_frame = told.append
    tag = mapper.AddObserver("VolumeMapperRenderStartEvent", lambda m, _: seen.append(settings(m)), -2.0)

    def counted():
        return steering.frames, steering.steered_frames, steering.fallback_frames

    before, state, distance = counted(), session.save_state(), steering.sample_distance
    selector = vtkHardwareSelector()
    selector.SetRenderer(view.renderer)
    selector.SetArea(0, 0, 199, 199)
    selector.SetFieldAssociation(vtkDataObject.FIELD_ASSOCIATION_CELLS)
    selector.Select()
    # A selection draws with the application's settings, does not count as a frame, and is not observed.
    assert seen and all(each == own for each in seen)
    assert told == []
    assert counted() == before
    assert steering.sample_distance == distance
    assert steering.leaves[0].session is session
    assert session.save_state() == state
    # A frame is steered, counted and observed.
    seen.clear()
    view.draw(1)
    mapper.RemoveObserver(tag)
    assert seen and seen[0] != own
    assert told == [steering]
    assert counted() == (before[0] + 1, before[1] + 1, before[2])
    assert steering.leaves[0].session.save_state() != state


def test_several_volumes_in_one_mapper(voxels):
    from vtkmodules.vtkRenderingVolume import vtkMultiVolume

    view = View()
    mapper, together = MAPPERS["gpu"](), vtkMultiVolume()
    mapper.SetAutoAdjustSampleDistances(0)
    together.SetMapper(mapper)
    other = View()
    for port in range(2):
        single = add_volume(other.renderer, voxels[: 48 - 10 * port])
        mapper.SetInputDataObject(port, single.GetMapper().GetInput())
        together.SetVolume(single, port)
    view.renderer.AddVolume(together)
    view.draw(2)
    plain = view.pixels()
    steering = entire.vtk.hold(view.renderer, together, 0.002)
    view.draw(10)
    assert steering.status == ""
    assert steering.steered_frames == 10
    steering.detach()
    view.draw(2)
    assert np.array_equal(view.pixels(), plain)
