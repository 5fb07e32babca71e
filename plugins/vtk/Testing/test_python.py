# SPDX-License-Identifier: MIT OR Apache-2.0
"""Tests that the Python module steers, and that the collector draws the same frames as `entire collect`."""
import csv
import os
import sys
import tempfile

import numpy as np

sys.path.insert(0, sys.argv[1])
import collect_vtk  # noqa: E402
import timing_table  # noqa: E402
import vtk_scene  # noqa: E402
from entire_vtk.vtkEntireSteering import vtkEntireSteering  # noqa: E402

view = vtk_scene.View("fixed", vtk_scene.image_data(vtk_scene.noise_volume(32)), (100, 80))
view.functions(
    vtk_scene.opacity_function(((0, 0.0), (255, 0.3))), vtk_scene.color_function(((0, 0, 0, 1), (255, 1, 1, 1)))
)
view.camera((60, 20, 60))
steering = vtkEntireSteering()
heard = []
steering.AddObserver(vtkEntireSteering.FrameEvent, lambda *_: heard.append(steering.GetSampleDistance()))
steering.SetTargetFrameTime(1e-6)
steering.SetStillUpdateRate(0)
assert steering.Attach(view.renderer, view.volume)
for _ in range(3):
    view.window.Render()
assert steering.GetNumberOfSteeredFrames() == 3 and len(heard) == 3, steering
assert heard[-1] > 4 and steering.GetReason() == "target unreachable"
assert view.mapper.GetSampleDistance() == 1.0
assert view.pixels().max() > 20

scene = timing_table.draw_scene(1, "volume.nrrd", 0)
text = ";".join(" ".join(timing_table.single_text(v) for v in lobe) for lobe in scene.lobes)
assert text == "0.3575599 0.0110967215 0.017436543;0.91632026 0.0006550259 0.5698056;0.05813787 0.010394635 0.07989768"
assert [timing_table.single_text(v) for v in (scene.rx, scene.ry, scene.dz)] == ["1.6128389", "32.929604", "3"]
assert (scene.width, scene.height, scene.step) == (36, 312, 1.0)
for path, name, place in (
    ("data/a.nrrd", "a.nrrd", ("", "")),
    ("x/castro/m01/t0012.nrrd", "castro/m01/t0012.nrrd", ("m01", "12")),
    ("x/castro/m02/../m01/t0012.nrrd", "castro/m01/t0012.nrrd", ("m01", "12")),
):
    volume = timing_table.Volume(path, np.zeros((1, 1, 1)), (1, 1, 1))
    assert (volume.seed_name(), volume.place()) == (name, place), path


class Clockwork:
    """A renderer that draws nothing; each frame's time is one second longer than the previous one's."""

    name, device, driver, skipping, termination, warm_up = "clockwork", "none", "none", "none", 1.0, 0
    drawn = 0

    def load(self, volume):
        assert volume.dims == (2, 3, 4)

    def prepare(self, scene):
        def draw():
            self.drawn += 1
            return float(self.drawn), float(self.drawn)

        return draw


with tempfile.TemporaryDirectory() as folder:
    paths = [os.path.join(folder, name) for name in ("a.nrrd", "b.nrrd")]
    for path in paths:
        timing_table.write_nrrd(path, np.zeros((4, 3, 2)))
    assert timing_table.read_nrrd(paths[0]).spacing == (1, 1, 1)
    turned = os.path.join(folder, "turned.nrrd")
    with open(turned, "wb") as file:
        file.write(b"NRRD0005\ntype: uint8\ndimension: 3\nsizes: 2 1 1\nspace dimension: 3\n")
        file.write(b"space directions: (0,3,4) (1,0,0) (0,0,-2)\nencoding: raw\n\n\0\1")
    assert timing_table.read_nrrd(turned).spacing == (5, 1, 2)
    out = os.path.join(folder, "t.csv")
    words = [*paths, "--out", out, "--frames", "2", "--passes", "2", "--repeats", "1", "--warm-up", "0"]
    timing_table.collect(timing_table.arguments("").parse_args(words), Clockwork())
    with open(out, newline="") as file:
        rows = [(r["frame"], r["repeat"], os.path.basename(r["volume"]), r["seconds_cpu"], r["tf"]) for r in csv.DictReader(file)]
    # The second pass follows the first, through all volumes, with the same frames.
    assert [r[:3] for r in rows[:4]] == [("0", "0", "a.nrrd"), ("1", "0", "a.nrrd"), ("2", "0", "b.nrrd"), ("3", "0", "b.nrrd")]
    assert [float(r[3]) for r in rows] == [1, 2, 3, 4, 5, 6, 7, 8]
    assert [(r[0], "0", r[2], r[4]) for r in rows[4:]] == [(r[0], "0", r[2], r[4]) for r in rows[:4]]
    assert {r[1] for r in rows[4:]} == {"1"}
    # The manifest has the name that `entire train` looks for, and no other table's manifest is replaced.
    os.rename(out, f"{out}.gz")
    for name, refused in (("t.csv", "t.csv.gz exists"), ("u.csv.gz", "leave .gz out"), ("frames.1", None)):
        words[words.index("--out") + 1] = os.path.join(folder, name)
        try:
            timing_table.collect(timing_table.arguments("").parse_args(words), Clockwork())
            assert not refused and os.path.exists(os.path.join(folder, f"{name}.manifest.json"))
        except SystemExit as error:
            assert refused and refused in str(error), error

    # Each picture of a scene is compared with the first, which has full quality.
    noise = os.path.join(folder, "noise.nrrd")
    timing_table.write_nrrd(noise, vtk_scene.noise_volume(32))
    words = [noise, "--out", out, "--frames", "2", "--repeats", "1", "--max-size", "64"]
    options = timing_table.arguments("").parse_args(words)
    options.pictures, options.scenes = os.path.join(folder, "pictures.csv"), 1
    renderer = collect_vtk.VtkRenderer("fixed", "none")
    collect_vtk.compare(options, renderer)
    assert renderer.name == renderer.view.mapper.GetClassName() == "vtkFixedPointVolumeRayCastMapper"
    with open(options.pictures, newline="") as file:
        rows = list(csv.DictReader(file))
    settings = [(float(r["step"]), float(r["image_sample_distance"])) for r in rows]
    assert settings == [(s, d) for d in collect_vtk.IMAGES for s in collect_vtk.STEPS]
    assert float(rows[0]["error"]) == 0 and all(float(r["error"]) > 0 for r in rows[6:]), rows
    assert all(float(r["seconds"]) > 0 for r in rows)
    # Pictures show the same volume as the timed frames.
    options.pictures, options.scenes, options.proxy = os.path.join(folder, "proxy.csv"), 0, 16
    collect_vtk.compare(options, renderer)
    assert renderer.volume.dims == (16, 16, 16)
