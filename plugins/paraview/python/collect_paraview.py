# SPDX-License-Identifier: MIT OR Apache-2.0
"""Writes timing tables of ParaView's volume rendering, in the format of `entire collect`.

    xvfb-run -a pvbatch collect_paraview.py --out paraview.csv --max-size 256 VOLUME.nrrd...
    entire calibrate --data paraview.csv --clock cpu --out paraview.safetensors

The times are those of whole still renders. ParaView sets the ray step itself, to about half the mean spacing; the table
contains that step.
"""
import os
import sys

if os.environ.get("PARAVIEW_MODULES"):
    sys.path.insert(0, os.environ["PARAVIEW_MODULES"])
import numpy as np
import paraview
from paraview.simple import *  # noqa: F401,F403
from paraview.vtk.util.numpy_support import numpy_to_vtk
from vtkmodules.vtkCommonDataModel import vtkImageData

sys.path.insert(
    0, os.path.join(os.path.dirname(os.path.abspath(__file__)), "..", "..", "vtk", "python")
)
import timing_table  # noqa: E402


class ParaViewRenderer:
    name, warm_up = "paraview", 1

    def __init__(self, mode, shade):
        self.mode, self.shade = mode, shade
        fixed = mode == "Ray Cast Only"
        self.skipping, self.termination = ("blocks", 0.99) if fixed else ("none", 0.996)
        self.device, self.driver = f"CPU, {mode}", f"ParaView {paraview.__version__}"
        self.producer = None
        self.view = CreateView("RenderView")
        self.view.OrientationAxesVisibility = 0
        self.view.UseColorPaletteForBackground = 0
        self.view.Background = [0, 0, 0]

    def load(self, volume):
        self.volume = volume
        image = vtkImageData()
        image.SetDimensions(*volume.dims)
        image.SetSpacing(*volume.spacing)
        image.SetOrigin(*(-0.5 * (n - 1) * s for n, s in zip(volume.dims, volume.spacing)))
        scalars = numpy_to_vtk(np.ascontiguousarray(volume.voxels).ravel(), deep=1)
        scalars.SetName("scalar")
        image.GetPointData().SetScalars(scalars)
        if self.producer:
            Delete(self.display)
            Delete(self.producer)
        self.producer = TrivialProducer()
        self.producer.GetClientSideObject().SetOutput(image)
        self.producer.UpdatePipeline()
        self.display = Show(self.producer, self.view)
        self.display.SetRepresentationType("Volume")
        ColorBy(self.display, ("POINTS", "scalar"))
        self.display.SetScalarBarVisibility(self.view, False)
        self.display.VolumeRenderingMode = self.mode
        self.display.ScalarOpacityUnitDistance = volume.reference_step
        self.display.Shade = 1 if self.shade == "local" else 0
        self.colors = GetColorTransferFunction("scalar")
        self.colors.RGBPoints = [0, 0.1, 0.2, 0.6, 128, 0.9, 0.5, 0.2, 255, 1.0, 1.0, 0.9]
        self.opacity = GetOpacityTransferFunction("scalar")
        # The step of mappers that are locked to the spacing: half the mean spacing, finer for volumes with few cells.
        mean = float(np.prod([n - 1 for n in volume.dims])) ** 0.333
        self.step = sum(volume.spacing) / 6.0 * (0.01 + 0.99 * mean / 100 if mean < 100 else 1.0)

    def prepare(self, scene):
        volume = self.volume
        scene.step = self.step / volume.reference_step
        self.view.ViewSize = [scene.width, scene.height]
        opacity = scene.opacity()
        points = np.zeros((opacity.size, 4))
        points[:, 0] = np.linspace(0.0, 255.0, opacity.size)
        points[:, 1] = opacity
        points[:, 2] = 0.5
        self.opacity.Points = points.ravel().tolist()
        toward, up = scene.eye()
        self.view.CameraFocalPoint = [0, 0, 0]
        self.view.CameraPosition = [scene.dz * volume.radius * c for c in toward]
        self.view.CameraViewUp = up
        self.view.CameraViewAngle = scene.fov_y
        self.view.SMProxy.UpdateVTKObjects()
        self.view.Update()
        return lambda: timing_table.timed(self.view.SMProxy.StillRender)


if __name__ == "__main__":
    parser = timing_table.arguments(__doc__.splitlines()[0])
    parser.add_argument("--mode", choices=("GPU Based", "Ray Cast Only"), default="GPU Based")
    options = parser.parse_args()
    if options.steps != parser.get_default("steps"):
        parser.error("ParaView sets the ray step itself; leave --steps out")
    timing_table.collect(options, ParaViewRenderer(options.mode, options.shade))
