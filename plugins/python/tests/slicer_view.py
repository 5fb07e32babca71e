# SPDX-License-Identifier: MIT OR Apache-2.0
"""A 3D view of Slicer without Slicer's windows: scene, volume rendering logic and displayable managers of slicer-core."""

import numpy as np
import slicer
from vtkmodules.util.numpy_support import numpy_to_vtk
from vtkmodules.vtkCommonCore import vtkCollection
from vtkmodules.vtkCommonDataModel import vtkImageData, vtkPiecewiseFunction
from vtkmodules.vtkRenderingCore import (
    vtkColorTransferFunction,
    vtkRenderer,
    vtkRenderWindow,
    vtkRenderWindowInteractor,
    vtkVolumeProperty,
)

from scenes import View

MANAGER = "vtkMRMLVolumeRenderingDisplayableManager"


class SlicerView(View):
    """One off-screen view with its interactor, and the scene that it shows."""

    def __init__(self, size=(200, 200)):
        super().__init__(size)
        self.interactor = vtkRenderWindowInteractor()
        self.interactor.SetRenderWindow(self.window)
        self.scene = slicer.vtkMRMLScene()
        self.application = slicer.vtkSlicerApplicationLogic()
        self.application.SetMRMLScene(self.scene)
        self.application.SetViewLogics(vtkCollection())
        self.application.SetSliceLogics(vtkCollection())
        self.logic = slicer.vtkSlicerVolumeRenderingLogic()
        self.logic.SetMRMLApplicationLogic(self.application)
        self.logic.SetMRMLScene(self.scene)
        factory = slicer.vtkMRMLThreeDViewDisplayableManagerFactory.GetInstance()
        factory.SetMRMLApplicationLogic(self.application)
        if not factory.IsDisplayableManagerRegistered(MANAGER):
            factory.RegisterDisplayableManager(MANAGER)
        self.group = slicer.vtkMRMLDisplayableManagerGroup()
        self.group.Initialize(factory, self.renderer)
        self.node = slicer.vtkMRMLViewNode()
        self.scene.AddNode(self.node)
        self.group.SetMRMLDisplayableNode(self.node)
        self.manager = self.group.GetDisplayableManagerByClassName(MANAGER)

    def show(self, voxels, spacing=(1.0, 1.0, 1.0), method="GPU"):
        """Adds a rendered volume node of [z, y, x] voxels; returns its display node."""
        image = vtkImageData()
        image.SetDimensions(*voxels.shape[::-1])
        image.GetPointData().SetScalars(numpy_to_vtk(np.ascontiguousarray(voxels).ravel(), deep=1))
        node = slicer.vtkMRMLScalarVolumeNode()
        node.SetSpacing(*spacing)
        node.SetOrigin(*(-0.5 * (n - 1) * s for n, s in zip(voxels.shape[::-1], spacing)))
        node.SetAndObserveImageData(image)
        self.scene.AddNode(node)
        kind = f"vtkMRML{method}RayCastVolumeRenderingDisplayNode"
        display = self.logic.CreateVolumeRenderingDisplayNode(kind)
        self.scene.AddNode(display)
        node.AddAndObserveDisplayNodeID(display.GetID())
        self.logic.UpdateDisplayNodeFromVolumeNode(display, node)
        display.SetVisibility(1)
        return display

    def move(self):
        """Requests the update rate that the interactor requests while a mouse button is down."""
        self.window.SetDesiredUpdateRate(self.interactor.GetDesiredUpdateRate())

    def rest(self):
        self.window.SetDesiredUpdateRate(self.interactor.GetStillUpdateRate())


def preset(display, opacity, color, shade=True):
    """Sets a display node's functions as a preset of Slicer does."""
    functions = vtkVolumeProperty()
    of_opacity, of_color = vtkPiecewiseFunction(), vtkColorTransferFunction()
    for at, value in opacity:
        of_opacity.AddPoint(at, value)
    for at, *rgb in color:
        of_color.AddRGBPoint(at, *rgb)
    functions.SetScalarOpacity(of_opacity)
    functions.SetColor(of_color)
    functions.SetInterpolationTypeToLinear()
    functions.SetShade(shade)
    node = slicer.vtkMRMLVolumePropertyNode()
    node.GetVolumeProperty().DeepCopy(functions)
    display.GetVolumePropertyNode().Copy(node)
