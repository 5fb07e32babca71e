# SPDX-License-Identifier: MIT OR Apache-2.0
"""The Python module steers, and the collector draws the frames that `entire collect` draws."""
import sys

sys.path.insert(0, sys.argv[1])
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
