"""One of VTK's volume mappers as a server: one command per line in, one line `@@{json}` out. Driven by render_bars.py.

usage: vtk_peer.py fixed|gpu

One mapper per process: in a window that both share, the GPU mapper takes more than three times as long.

    volume FILE NX NY NZ SX SY SZ     raw bytes; the box begins at the origin, half a spacing before the first voxel center
    table FILE                        256 RGBA as f32, for the values 0 to 255; opacities are per smallest spacing
    camera EX EY EZ FX FY FZ UX UY UZ FOV WIDTH HEIGHT
    frame                             renders; seconds by wall clock and of this process's threads
    image FILE                        renders and writes RGB bytes, rows from the top
"""
import json
import struct
import sys
import time

from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
from vtkmodules.vtkCommonCore import VTK_UNSIGNED_CHAR, vtkUnsignedCharArray, vtkVersion
from vtkmodules.vtkCommonDataModel import vtkImageData, vtkPiecewiseFunction
from vtkmodules.vtkRenderingCore import (vtkColorTransferFunction, vtkRenderer, vtkRenderWindow, vtkVolume,
                                         vtkVolumeProperty)
from vtkmodules.vtkRenderingVolume import vtkFixedPointVolumeRayCastMapper, vtkGPUVolumeRayCastMapper
import vtkmodules.vtkRenderingOpenGL2  # noqa: F401  (registers the window)
import vtkmodules.vtkRenderingVolumeOpenGL2  # noqa: F401  (registers the mapper)
import numpy


class Peer:
    def __init__(self, kind):
        self.renderer = vtkRenderer()
        self.renderer.SetBackground(0, 0, 0)
        self.window = vtkRenderWindow()
        self.window.SetOffScreenRendering(1)
        self.window.SetMultiSamples(0)
        self.window.AddRenderer(self.renderer)
        self.property = vtkVolumeProperty()
        self.property.ShadeOff()
        self.property.SetInterpolationTypeToLinear()
        if kind == "fixed":
            self.mapper = vtkFixedPointVolumeRayCastMapper()
            self.mapper.LockSampleDistanceToInputSpacingOff()
            self.mapper.SetImageSampleDistance(1.0)
        else:
            self.mapper = vtkGPUVolumeRayCastMapper()
            self.mapper.SetLockSampleDistanceToInputSpacing(0)
            self.mapper.SetUseJittering(0)
        self.mapper.SetAutoAdjustSampleDistances(0)
        self.mapper.SetBlendModeToComposite()
        volume = vtkVolume()
        volume.SetMapper(self.mapper)
        volume.SetProperty(self.property)
        self.scene = volume

    def volume(self, path, *numbers):
        dims = [int(n) for n in numbers[:3]]
        spacing = [float(s) for s in numbers[3:]]
        # VTK refers to the array, which must live as long as the image.
        self.voxels = numpy.fromfile(path, dtype=numpy.uint8)
        image = vtkImageData()
        image.SetDimensions(dims)
        image.SetSpacing(spacing)
        image.SetOrigin([0.5 * s for s in spacing])
        scalars = numpy_to_vtk(self.voxels, deep=0, array_type=VTK_UNSIGNED_CHAR)
        image.GetPointData().SetScalars(scalars)
        self.image = image
        step = min(spacing)
        self.mapper.SetInputData(image)
        self.mapper.SetSampleDistance(step)
        self.property.SetScalarOpacityUnitDistance(step)
        self.renderer.AddVolume(self.scene)
        return {}

    def table(self, path):
        with open(path, "rb") as file:
            values = struct.unpack("<1024f", file.read())
        color, opacity = vtkColorTransferFunction(), vtkPiecewiseFunction()
        for i in range(256):
            r, g, b, a = values[4 * i:4 * i + 4]
            color.AddRGBPoint(i, r, g, b)
            opacity.AddPoint(i, a)
        self.property.SetColor(color)
        self.property.SetScalarOpacity(opacity)
        return {}

    def camera(self, *numbers):
        n = [float(v) for v in numbers]
        self.window.SetSize(int(n[10]), int(n[11]))
        camera = self.renderer.GetActiveCamera()
        camera.SetPosition(n[:3])
        camera.SetFocalPoint([n[i] + n[3 + i] for i in range(3)])
        camera.SetViewUp(n[6:9])
        camera.SetViewAngle(n[9])
        self.renderer.ResetCameraClippingRange()
        return {}

    def frame(self):
        wall, cpu = time.perf_counter(), time.process_time()
        self.window.Render()
        self.window.WaitForCompletion()
        return {"wall": time.perf_counter() - wall, "cpu": time.process_time() - cpu}

    def picture(self, path):
        self.window.Render()
        pixels = vtkUnsignedCharArray()
        width, height = self.window.GetSize()
        self.window.GetPixelData(0, 0, width - 1, height - 1, 1, pixels, 0)
        rows = vtk_to_numpy(pixels).reshape(height, width, 3)[::-1]
        rows.tofile(path)
        return {"width": width, "height": height}


def main():
    peer = Peer(sys.argv[1])
    peer.window.SetSize(16, 16)
    peer.window.Render()
    lines = [l.split(":", 1)[1].strip() for l in peer.window.ReportCapabilities().splitlines()
             if l.startswith(("OpenGL renderer string", "OpenGL version string"))]
    say({"name": f"VTK {vtkVersion.GetVTKVersion()}", "window": peer.window.GetClassName(), "gl": ", ".join(lines)})
    commands = {"volume": peer.volume, "table": peer.table, "camera": peer.camera, "frame": peer.frame,
                "image": peer.picture}
    for line in sys.stdin:
        name, *rest = line.split()
        try:
            say(commands[name](*rest))
        except Exception as error:  # render_bars.py prints it
            say({"err": f"{line.strip()}: {error!r}"})


def say(answer):
    print("@@" + json.dumps(answer), flush=True)


main()
