# SPDX-License-Identifier: MIT OR Apache-2.0
"""Arrays of any dtype and layout give the same predictions as a contiguous copy."""

import gc
import warnings
import weakref

import numpy as np
import pytest

import entire

ORBIT = np.stack([np.linspace(-60, 60, 7), np.linspace(0, 300, 7), np.linspace(1.5, 3, 7)], axis=1)


def seconds(volume, tf):
    return entire.predict(volume, ORBIT, tf, (200, 150))


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "int16", "float32"])
def test_native_arrays_are_not_copied(voxels, dtype, tf):
    array = voxels.astype(dtype)
    volume = entire.Volume(array, (1, 2, 3))
    assert not volume.copied
    assert volume.array is array
    assert volume.shape == array.shape[::-1]
    assert volume.spacing == (1, 2, 3)
    assert volume.array.__array_interface__["data"][0] == array.__array_interface__["data"][0]


@pytest.mark.parametrize(
    "dtype",
    ["bool", "int8", ">u2", ">i2", ">f4", "uint32", "int32", "float64", "float16", "uint64", "int64", ">f8"],
)
def test_other_types_are_converted_to_the_same_values(voxels, dtype, tf):
    plain = (voxels > 60 if dtype == "bool" else voxels // 2).astype(dtype)
    volume = entire.Volume(plain, range=(0, 127))
    assert volume.copied is (dtype != "bool")
    expected = entire.Volume(plain.astype(np.float32), range=(0, 127))
    assert np.array_equal(np.asarray(volume.array, np.float32), np.asarray(expected.array))
    # The type affects the cost of a sample, so predicted times may differ; the visible voxels are the same.
    assert np.allclose(seconds(volume, tf), seconds(expected, tf), rtol=0.6)


@pytest.mark.parametrize(
    "view",
    [
        lambda a: a[::2, ::3, ::1],
        lambda a: a[3:40, 5:30, 7:47],
        lambda a: np.asfortranarray(a),
        lambda a: a.transpose(1, 2, 0),
        lambda a: a[::-1],
        lambda a: a[:, :, ::-2],
        lambda a: np.broadcast_to(a[:1], (20, *a.shape[1:])),
    ],
    ids=["steps", "box", "fortran", "transposed", "flipped", "flipped steps", "broadcast"],
)
def test_strided_views_are_read_as_their_copies_are(voxels, view, tf):
    array = view(voxels)
    volume = entire.Volume(array)
    assert volume.copied is any(s < 0 for s in array.strides)
    assert np.array_equal(seconds(volume, tf), seconds(entire.Volume(np.ascontiguousarray(array)), tf))


def test_read_only_arrays_do(voxels, tf):
    array = voxels.copy()
    array.flags.writeable = False
    volume = entire.Volume(array)
    assert not volume.copied
    assert np.array_equal(seconds(volume, tf), seconds(entire.Volume(voxels), tf))


def test_unaligned_arrays_are_copied(tf):
    raw = np.arange(1 + 2 * 8 * 9 * 10, dtype=np.uint8)
    array = raw[1:].view(np.uint16).reshape(8, 9, 10)
    assert entire.Volume(array).copied is (array.ctypes.data % 2 != 0)
    assert np.array_equal(seconds(entire.Volume(array), tf), seconds(entire.Volume(array.copy()), tf))


def test_axes_name_the_same_voxels(voxels, tf):
    box = np.ascontiguousarray(voxels[:, 5:40, 3:20])
    a = entire.Volume(box, (1, 2, 3))
    b = entire.Volume(np.ascontiguousarray(box.transpose(2, 1, 0)), (1, 2, 3), axes="xyz")
    assert a.shape == b.shape == (17, 35, 48)
    assert np.array_equal(seconds(a, tf), seconds(b, tf))


def test_the_array_lives_as_long_as_the_volume():
    array = np.zeros((4, 4, 4), np.uint16)
    gone = weakref.ref(array)
    volume = entire.Volume(array[1:, :, :])
    del array
    gc.collect()
    assert gone() is not None
    session = entire.Session(volume)
    del volume
    gc.collect()
    assert session is not None
    del session
    gc.collect()
    assert gone() is None


def test_memory_of_another_owner_is_kept():
    owner = bytearray(4 * 4 * 4)
    volume = entire.Volume(np.frombuffer(owner, np.uint8).reshape(4, 4, 4))
    with pytest.raises(BufferError):
        owner.extend(b"1")
    assert volume.shape == (4, 4, 4)


@pytest.mark.parametrize(
    ("array", "options", "error", "text"),
    [
        (np.zeros((4, 4)), {}, ValueError, "a volume has three"),
        (np.zeros((4, 4, 4, 3)), {}, ValueError, "Choose a time step or a component"),
        (np.zeros((4, 0, 4)), {}, ValueError, "along y is 0"),
        (np.zeros((4, 4, 4), complex), {}, TypeError, "complex128"),
        (np.full((2, 2, 2), "a"), {}, TypeError, "integers, floats and bool"),
        (np.ma.masked_array(np.full((2, 2, 2), "a"), False), {}, TypeError, "integers, floats and bool"),
        (np.ma.masked_array(np.zeros((4, 0, 4)), False), {}, ValueError, "along y is 0"),
        (np.zeros((4, 4, 4)), {"spacing": (1, 0, 1)}, ValueError, "positive"),
        (np.zeros((4, 4, 4)), {"spacing": (1, float("nan"), 1)}, ValueError, "positive"),
        (np.zeros((4, 4, 4)), {"axes": "yxz"}, ValueError, "array\\[z, y, x\\]"),
        (np.zeros((4, 4, 4)), {"range": (2, 1)}, ValueError, "range"),
        (np.zeros((4, 4, 4)), {"origin": (0, float("inf"), 0)}, ValueError, "finite"),
    ],
)
def test_what_cannot_be_used_is_refused_with_a_remedy(array, options, error, text):
    with pytest.raises(error, match=text):
        entire.Volume(array, **options)


def test_not_finite_voxels_and_flat_volumes_do(tf):
    array = np.full((8, 8, 8), np.nan, np.float32)
    assert np.isfinite(seconds(entire.Volume(array), tf)).all()
    array[0, 0, :3] = (1, np.inf, 3)
    assert entire.Volume(array).range == (1, 3)
    assert np.isfinite(seconds(entire.Volume(np.full((8, 8, 8), 5, np.int64)), tf)).all()
    huge = np.array([1e300, -1e300, 0, 1] * 2).reshape(2, 2, 2)
    assert np.isfinite(seconds(entire.Volume(huge), tf)).all()


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32", "float64"])
@pytest.mark.parametrize("axes", ["zyx", "xyz"])
def test_time_steps_are_as_volumes_of_their_own(voxels, dtype, axes, tf):
    array = voxels.astype(dtype)
    first = volume = entire.Volume(array, (1, 2, 3), axes=axes, range=(0, 255))
    for step in range(4):
        array[3 * step, 2:9, 5:30] = 250 - 40 * step
        changed = ((3 * step, 3 * step + 1), (2, 9), (5, 30)) if step % 2 else None
        volume = volume.next(array, changed)
        alone = entire.Volume(array.copy(), (1, 2, 3), axes=axes, range=(0, 255))
        assert volume.range == (0, 255) and volume.spacing == (1, 2, 3) and volume.shape == alone.shape
        assert np.array_equal(seconds(volume, tf), seconds(alone, tf))
    # After next() on a step that is not the latest, changes are found even if the caller declared too few.
    array[20:] = 0
    branch = first.next(array, ((0, 1), (0, 1), (0, 1)))
    assert np.array_equal(seconds(branch, tf), seconds(entire.Volume(array.copy(), (1, 2, 3), axes=axes, range=(0, 255)), tf))


def test_a_session_follows_time_steps(voxels, tf):
    array = voxels.copy()
    volume = entire.Volume(array)
    session = entire.Session(volume)
    camera = entire.Camera.arcball(20, 30, 2.5)
    for _ in range(3):
        plan = session.plan(camera, tf, (200, 150), 0.02)
        session.observe(plan, 0.01)
        array[5:20] //= 2
        volume = volume.next(array)
        session.set_volume(volume)
    assert session.plan(camera, None, (200, 150), 0.02).step >= 1


def test_what_is_no_time_step_is_refused(voxels):
    volume = entire.Volume(voxels)
    for other in (voxels[1:], voxels.astype(np.int16)):
        with pytest.raises(ValueError):
            volume.next(other)
    with pytest.raises(ValueError):
        volume.next(voxels, ((0, voxels.shape[0] + 1), (0, 1), (0, 1)))
    with pytest.raises(ValueError, match="not be negative"):
        volume.next(voxels, ((-1, 1), (0, 1), (0, 1)))


def _values(shape=(12, 11, 10)):
    return np.random.default_rng(3).random(shape, np.float32)


@pytest.mark.parametrize("fill", [-9999.0, 1e20, 9.969209968386869e36])
def test_fill_values_do_not_decide_the_range(fill):
    array = _values()
    data = array.copy()
    array[::3] = fill
    expected = np.delete(data, np.s_[::3], axis=0)
    with pytest.warns(UserWarning, match="taken as a fill value"):
        volume = entire.Volume(array)
    assert volume.range == (expected.min(), expected.max())
    # Only fill values above the range are replaced, in a copy of the array.
    assert volume.copied == (fill > 0)
    assert array[0, 0, 0] == np.float32(fill)
    assert volume.array.max() == (expected.max() if fill > 0 else array.max())
    assert entire.Volume(array, fill=None).range == (min(fill, expected.min()), max(np.float32(fill), expected.max()))
    with pytest.warns(UserWarning, match="hidden by a mask or a fill value"):
        assert entire.Volume(array, fill=fill).range == volume.range
    # The next time step hides the same values, without a warning.
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert volume.next(array).range == volume.range


def test_masked_arrays_hide_their_voxels():
    array = np.arange(1000, dtype=np.int16).reshape(10, 10, 10)
    masked = np.ma.masked_greater(array, 499)
    with pytest.warns(UserWarning, match="500 voxels are hidden"):
        volume = entire.Volume(masked)
    assert (volume.range, volume.copied, volume.array.max()) == ((0, 499), True, 499)
    # An empty mask hides nothing.
    assert entire.Volume(np.ma.masked_array(array)).range == (0, 999)
    with pytest.raises(ValueError, match="every voxel is hidden"):
        entire.Volume(np.ma.masked_all((4, 4, 4)))


@pytest.mark.parametrize(("dtype", "bounds", "low"), [("uint8", None, 0), ("int16", (-50.5, 400), -51), ("float32", (-2, 9), -2)])
@pytest.mark.filterwarnings("ignore:.*hidden by a mask")
def test_hidden_voxels_have_the_low_end_of_the_range(dtype, bounds, low):
    array = np.linspace(100, 250, 1000).astype(dtype).reshape(10, 10, 10)
    volume = entire.Volume(np.ma.masked_less(array, 150), range=bounds)
    assert volume.array[0, 0, 0] == low
    assert volume.array.max() == array.max()


@pytest.mark.parametrize("dtype", ["int8", "int16", "uint32", "int64", "float64"])
@pytest.mark.filterwarnings("ignore:.*hidden by a mask")
def test_the_low_end_of_the_range_may_lie_beyond_the_arrays_type(dtype):
    array = np.arange(64, dtype=dtype).reshape(4, 4, 4)
    volume = entire.Volume(np.ma.masked_less(array, 9), range=(-500, 63))
    assert (volume.array[0, 0, 0], volume.array[0, 2, 1], volume.array.max()) == (-500, 9, 63)


@pytest.mark.filterwarnings("ignore:.*hidden by a mask")
def test_hidden_voxels_of_bool_are_false():
    array = np.zeros((4, 4, 4), bool)
    array[0] = True
    assert not entire.Volume(np.ma.masked_array(array, array), range=(-1, 1)).array.any()


@pytest.mark.filterwarnings("ignore:.*taken as a fill value")
def test_a_time_step_may_be_hidden_completely():
    array = _values()
    array[::3] = 1e20
    volume = entire.Volume(array)
    later = volume.next(np.full_like(array, 1e20))
    assert later.range == volume.range
    assert later.array.max() == volume.range[0]


def test_a_fill_value_that_hides_nothing_changes_nothing(tf):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        volume = entire.Volume(np.full((4, 4, 4), np.nan, np.float32), fill=-9999)
    assert np.isfinite(seconds(volume, tf)).all()


def test_a_fill_value_beyond_float32_hides_its_voxels():
    array = _values().astype(np.float64)
    data = array[1:].astype(np.float32)
    array[0] = np.finfo(np.float64).min
    with pytest.warns(UserWarning) as warned:
        volume = entire.Volume(array, fill=array[0, 0, 0])
    assert volume.range == (data.min(), data.max())
    assert ["voxels are hidden" in str(each.message) for each in warned] == [True]


def test_nan_is_said_once_and_decides_nothing():
    array = _values()
    array[0] = np.nan
    with pytest.warns(UserWarning, match="110 of 1320 voxels are NaN or infinite"):
        volume = entire.Volume(array)
    assert volume.range == (np.nanmin(array), np.nanmax(array))


def test_a_fill_value_is_auto_none_or_numbers():
    with pytest.raises(ValueError, match='fill is "never"'):
        entire.Volume(np.zeros((4, 4, 4), np.float32), fill="never")
    array = np.arange(64, dtype=np.float32).reshape(4, 4, 4)
    with pytest.warns(UserWarning, match="2 voxels"):
        assert entire.Volume(array, fill=[0.0, 63.0]).range == (1, 62)


def test_a_value_that_is_not_declared_as_a_fill_value_is_data():
    array = _values((16, 16, 16))
    array[0, :8] = -9999
    array[1, :8] = 1e6
    with pytest.warns(UserWarning, match="128 voxels are hidden") as warned:
        volume = entire.Volume(array, fill=-9999)
    assert len(warned) == 1
    assert volume.range[1] == np.float32(1e6)
    assert volume.array.max() == np.float32(1e6)
