# SPDX-License-Identifier: MIT OR Apache-2.0
"""Measures the Python package: lines `bar NAME VALUE LIMIT ok|short`.

    make bars-python
    plugins/python/run.sh bars --only frames,overhead

The frames are those of `make bars-vtk`: 256^3 voxels of noise, 512 x 512 pixels, 200 frames of an orbit. The opacity
function changes three times between a transparent and an opaque one. The target is half of the mean frame time at full
quality, in processor time. `cold` steers without a calibrated model; `calibrated` steers by a model that is fitted to
frames of another volume, from a simulation.

A value that cannot be measured is printed as `-` and counts as short. The exit status is 1 if a bar is short.
"""

import argparse
import ctypes
import gc
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[2]
# Folders of the modules with the volume, path and functions of `make bars-vtk`, and of bar_lines.py.
sys.path[:0] = [str(HERE.parent / "tests"), str(ROOT / "plugins/vtk/python"), str(ROOT / "lab/scripts")]
from bar_lines import Bars  # noqa: E402

try:
    import numpy as np
    from vtk_noise import noise_volume

    MISSING = None
except ImportError as error:
    MISSING = f"{error} (make bars-python makes an environment that has it)"

# File of the volume to whose frames the model of `calibrated` is fitted; the evaluated volume is noise.
OTHER = ROOT / "data/nyx_cosmology/m01/t0010.nrrd"
# Numbers of the frames, out of 200, at which the opacity function changes.
SWITCHES = (50, 100, 150)

THREE_LINES = """\
pl = pv.Plotter(window_size=(300, 300)); pl.add_volume(v)
pl.entire.hold(fps=30)
pl.show(auto_close=False, interactive=False)
"""


class Path200:
    """A scene with an orbiting camera. Its opacity function alternates between a transparent and an opaque one."""

    def __init__(self, voxels, size, frames):
        from scenes import OPAQUE, TRANSPARENT, View, add_volume
        from vtk_scene import camera, opacity_function

        self.orbit = camera
        self.n, self.frames = voxels.shape[0], frames
        self.view = View((size, size))
        self.volume = add_volume(self.view.renderer, voxels)
        self.functions = [opacity_function(points) for points in (TRANSPARENT, OPAQUE)]

    def draw(self, frame):
        opaque = sum(frame >= self.frames * s // 200 for s in SWITCHES) % 2
        self.volume.GetProperty().SetScalarOpacity(self.functions[opaque])
        camera = self.view.renderer.GetActiveCamera()
        camera.SetViewAngle(45)
        camera.SetFocalPoint(0, 0, 0)
        camera.SetPosition(*self.orbit(frame, self.frames, self.n))
        camera.SetViewUp(0, 1, 0)
        self.view.renderer.ResetCameraClippingRange()
        before = time.process_time()
        self.view.window.Render()
        return time.process_time() - before


def calibrated(options):
    """Fits a model to 60 random frames of the volume `OTHER`, resampled to the evaluated number of voxels."""
    import entire.vtk
    from timing_table import read_nrrd, resampled

    voxels = resampled(read_nrrd(OTHER), options.edge).voxels
    other = Path200(voxels, options.size, options.frames)
    other.draw(0)
    return entire.vtk.calibrate(other.view.renderer, other.volume, frames=60, clock="cpu")


def frames_held(options, bars):
    import entire.vtk

    voxels = noise_volume(options.edge)
    path = Path200(voxels, options.size, options.frames)
    for _ in range(2):
        path.draw(0)
    full = [path.draw(f) for f in range(0, options.frames, 10)]
    target = 0.5 * statistics.fmean(full)
    print(
        f"target {1e3 * target:.1f} ms of processor time, full quality {1e3 * statistics.fmean(full):.1f} ms",
        flush=True,
    )
    figures = {}
    for name, make in (("cold", lambda _: None), ("calibrated", calibrated)):
        model = make(options)
        path = Path200(voxels, options.size, options.frames)
        steering = entire.vtk.hold(path.view.renderer, path.volume, target, clock="cpu", model=model)
        path.volume.VisibilityOff()
        path.view.window.Render()
        path.volume.VisibilityOn()
        times, overhead = [], []
        for frame in range(options.frames):
            times.append(path.draw(frame))
            overhead.append(steering.overhead)
            if steering.reason == "fallback":
                raise RuntimeError(f"{name}: not steered: {steering.status}")
        relative = np.array(times) / target
        figures[name] = {"relative": relative.tolist(), "overhead": overhead}
        late = float(np.mean(relative > 1.25))
        bars.found(f"error-{name}", float(np.mean(np.abs(relative - 1))), f"mean {1e3 * np.mean(times):.1f} ms")
        bars.found(f"late-{name}", late, "share of frames over 1.25 x target")
        cost = 1e6 * statistics.median(overhead)
        bars.found(f"overhead-{name}", cost, "microseconds per frame, median, all work in Python included")
    (options.out / "frames.json").write_text(json.dumps(figures))


def three_lines(options, bars):
    wheels = sorted(Path(options.wheels).glob("entire-*.whl"))
    if not wheels:
        raise FileNotFoundError(f"no wheel in {options.wheels}; run `make wheel`")
    wheel = wheels[0]
    bars.found("wheel", wheel.stat().st_size / 1e6, "MB")
    folder = options.out / "clean"
    subprocess.run([sys.executable, "-m", "venv", "--clear", folder], check=True)
    python = folder / "bin" / "python"
    subprocess.run([python, "-m", "pip", "install", "--quiet", f"{wheel}[pyvista]"], check=True)
    program = (
        "import numpy as np, pyvista as pv\n"
        "v = pv.wrap(np.random.default_rng(0).integers(0, 255, (64, 64, 64), np.uint8))\n"
        + THREE_LINES
        + "i = pl.render_window.GetInteractor()\n"
        "i.SetEventInformation(150, 150, 0, 0); i.InvokeEvent('LeftButtonPressEvent')\n"
        "for k in range(20): i.SetEventInformation(150 + 3 * k, 150, 0, 0); i.InvokeEvent('MouseMoveEvent')\n"
        "s = pl.entire.steering\n"
        "assert s.steered_frames >= 19 and s.status == '', s\n"
        "print(s.steered_frames)\n"
    )
    run = subprocess.run([python, "-c", program], capture_output=True, text=True)
    if run.returncode:
        raise RuntimeError(f"the three lines do not hold a frame rate: {run.stderr[-600:]}")
    bars.found("lines", len(THREE_LINES.splitlines()), f"{run.stdout.strip()} steered frames")


def many_views(options, bars):
    import entire

    volume = entire.Volume(noise_volume(128))
    tf = entire.TransferFunction.points([(0, 0), (0.1, 0), (1, 0.2)])
    rng = np.random.default_rng(0)
    views = rng.uniform((-80, 0, 1.2), (80, 360, 4), (10_000, 3)).astype(np.float32)
    for model in (None, "unshaded-selected"):
        entire.predict(volume, views[:100], tf, (1280, 720), model=model)
        times = []
        for _ in range(5):
            before = time.process_time()
            together = entire.predict(volume, views, tf, (1280, 720), model=model)
            times.append(time.process_time() - before)
        session = entire.Session(volume, model=model)
        alone = np.array(
            [session.predict(entire.Camera.arcball(*map(float, v)), tf, (1280, 720)).seconds for v in views],
            np.float32,
        )
        name = model or "untrained"
        bars.found(f"views-{name}", min(times), "seconds of one core for 10,000 views")
        bars.found(f"views-{name}-other-bits", int((together.view(np.uint32) != alone.view(np.uint32)).sum()))


class Desc(ctypes.Structure):
    _fields_ = [
        ("struct_size", ctypes.c_size_t),
        ("voxels", ctypes.c_void_p),
        ("voxel_count", ctypes.c_size_t),
        ("scalar_type", ctypes.c_uint32),
        ("ownership", ctypes.c_uint32),
        ("dims", ctypes.c_size_t * 3),
        ("strides", ctypes.c_size_t * 3),
        ("spacing", ctypes.c_float * 3),
        ("range", ctypes.c_float * 2),
        ("reserved", ctypes.c_uint32),
    ]


def volume_of_512(options, bars):
    import entire

    array = np.random.default_rng(0).integers(0, 4095, (512, 512, 512), np.uint16)
    library = ctypes.CDLL(str(options.library))
    library.entire_volume_free.argtypes = [ctypes.c_void_p]
    desc = Desc()
    assert library.entire_volume_desc_init(ctypes.byref(desc), ctypes.c_size_t(ctypes.sizeof(desc))) == 0
    desc.voxels, desc.voxel_count = array.ctypes.data, array.size
    desc.scalar_type, desc.ownership = 3, 2  # ENTIRE_SCALAR_U16, ENTIRE_VOXELS_BORROW
    desc.dims[:] = array.shape[::-1]

    def c_call():
        volume = ctypes.c_void_p()
        before = time.process_time()
        assert library.entire_volume_new(ctypes.byref(desc), ctypes.byref(volume)) == 0
        seconds = time.process_time() - before
        library.entire_volume_free(volume)
        return seconds

    def python_call():
        before = time.process_time()
        volume = entire.Volume(array)
        seconds = time.process_time() - before
        assert not volume.copied
        return seconds

    before = resident()
    kept = entire.Volume(array)
    copies = round((resident() - before) / array.nbytes)
    del kept
    c_times, python_times = [], []
    for _ in range(7):
        c_times.append(c_call())
        python_times.append(python_call())
    ratio = min(python_times) / min(c_times)
    bars.found("volume-copies", copies)
    bars.found(
        "volume-over-c", ratio, f"{1e3 * min(python_times):.1f} ms, the C call {1e3 * min(c_times):.1f} ms"
    )


def resident():
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def leaks(options, bars):
    import entire
    import entire.vtk
    from scenes import View, add_volume

    voxels = noise_volume(16)
    tf, camera = entire.TransferFunction.points([(0, 0), (1, 0.1)]), entire.Camera.arcball(20, 30, 2.5)
    volume = entire.Volume(voxels)

    def session():
        made = entire.Session(volume)
        made.observe(made.plan(camera, tf, (64, 64), 0.01), 0.01)

    view = View((32, 32))
    drawn = add_volume(view.renderer, voxels, "smart")

    def attach():
        entire.vtk.hold(view.renderer, drawn, 0.01).detach()

    for name, cycle, count in (("sessions", session, 100_000), ("attaching", attach, 10_000)):
        for _ in range(count // 20):
            cycle()
        before = resident()
        for _ in range(count):
            cycle()
        bars.found(f"leak-{name}", (resident() - before) / 1e6, f"MB over {count} cycles")


def still_pictures(options, bars):
    import entire.vtk
    from scenes import View, add_volume

    voxels, differing, compared = noise_volume(96), 0, 0
    for kind in ("gpu", "fixed", "smart"):
        view = View((256, 256))
        volume = add_volume(view.renderer, voxels, kind)
        view.draw(1)
        plain = []
        for degrees in range(0, 360, 30):
            view.orbit(degrees, 200)
            view.window.Render()
            plain.append(view.pixels())
        steering = entire.vtk.hold(view.renderer, volume, 1e-3)
        for i, degrees in enumerate(range(0, 360, 30)):
            view.orbit(degrees + 10, 200)
            view.window.Render()
            view.orbit(degrees, 200)
            with steering.still():
                view.window.Render()
            differing += int((view.pixels() != plain[i]).sum())
            compared += plain[i].size
    bars.found("still-bytes-differing", differing, f"of {compared}, three mappers")


VIEWS = {"": 0.5, "-other-bits": 0}
# Measurements, each with its bars and their limits.
MEASURES = {
    "lines": (three_lines, {"lines": 3, "wheel": 15}),
    "still": (still_pictures, {"still-bytes-differing": 0}),
    "views": (
        many_views,
        {f"views-{m}{what}": limit for m in ("untrained", "unshaded-selected") for what, limit in VIEWS.items()},
    ),
    "volume": (volume_of_512, {"volume-copies": 0, "volume-over-c": 1.1}),
    "leaks": (leaks, {"leak-sessions": 1, "leak-attaching": 1}),
    "frames": (
        frames_held,
        {
            **{"error-cold": 0.12, "late-cold": 0.02, "overhead-cold": 150},
            **{"error-calibrated": 0.08, "late-calibrated": 0.02, "overhead-calibrated": 150},
        },
    ),
}


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--wheels", default=ROOT / "out" / "wheels")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "python")
    parser.add_argument("--library", type=Path, default=ROOT / "target" / "release" / "libentire.so")
    parser.add_argument("--only", default=",".join(MEASURES), help="comma-separated: " + ", ".join(MEASURES))
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--edge", type=int, default=256, help="voxels along each side")
    parser.add_argument("--size", type=int, default=512, help="pixels along each side")
    parser.add_argument("--lacking", help="measure nothing and print all bars as short, with this reason")
    options = parser.parse_args()
    unknown = [name for name in options.only.split(",") if name not in MEASURES]
    if unknown:
        parser.error(f"--only names {', '.join(unknown)}; there are {', '.join(MEASURES)}")
    options.out = options.out.resolve()
    options.out.mkdir(parents=True, exist_ok=True)
    measures = [MEASURES[name] for name in options.only.split(",")]
    with Bars({name: limit for _, limits in measures for name, limit in limits.items()}) as bars:
        if options.lacking or MISSING:
            sys.exit(options.lacking or MISSING)
        for measure, limits in measures:
            with bars.part(*limits):
                measure(options, bars)


if __name__ == "__main__":
    main()
