# SPDX-License-Identifier: MIT OR Apache-2.0
"""3D Slicer's views: their volume rendering held to the frame rate that the view is told to expect.

In Slicer::

    steering = entire.slicer.hold(slicer.app.layoutManager().threeDWidget(0).threeDView())

with ``slicer-core`` or trame-slicer, where there is no such widget: ``entire.slicer.hold(manager)``.
"""

from __future__ import annotations

from typing import Any

from .vtk import Steering
from .vtk._leaf import weak

_MANAGER = "vtkMRMLVolumeRenderingDisplayableManager"
# vtkMRMLViewNode's VolumeRenderingQuality that promises full quality whatever it takes.
_MAXIMUM = 2


class SlicerSteering(Steering):
    """Steering of a view's volumes. Made by :func:`hold`.

    The target follows the view node's expected frame rate. Nothing is steered while its quality is "Maximum".
    """

    def __init__(self, manager: Any, node: Any, seconds: float | None, **options: Any) -> None:
        self._node = weak(node)
        self._node_tag = 0
        self._fixed = seconds is not None
        super().__init__(manager.GetRenderer(), None, seconds or _expected(node), **options)
        self._node_tag = node.AddObserver("ModifiedEvent", self._on_node)
        self._on_node(node, "")

    def detach(self) -> None:
        """Lets go of the view: mappers are as Slicer left them."""
        node = self._node()
        if node is not None and self._node_tag:
            node.RemoveObserver(self._node_tag)
        self._node_tag = 0
        super().detach()

    def _on_node(self, node: Any, _event: str) -> None:
        if not self._fixed:
            self.seconds = _expected(node)
        self.enabled = node.GetVolumeRenderingQuality() != _MAXIMUM

    def _is_still(self, window: Any) -> bool:
        interactor = window.GetInteractor()
        if self._still or self.always is not None or interactor is None:
            return super()._is_still(window)
        # Slicer asks VTK for a lower rate than it expects: below 5 frames per second for less than one.
        return bool(window.GetDesiredUpdateRate() <= interactor.GetStillUpdateRate())


def _expected(node: Any) -> float:
    return 1.0 / max(float(node.GetExpectedFPS()), 1e-4)


def _manager(view: Any) -> Any:
    """The displayable manager of volume rendering of what is called a view."""
    if hasattr(view, "threeDView"):
        view = view.threeDView()
    if hasattr(view, "displayableManagerByClassName"):
        return view.displayableManagerByClassName(_MANAGER)
    group = getattr(view, "displayable_manager_group", view)
    if hasattr(group, "GetDisplayableManagerByClassName"):
        return group.GetDisplayableManagerByClassName(_MANAGER)
    return group if hasattr(group, "IsA") and group.IsA(_MANAGER) else None


def hold(view: Any, *, seconds: float | None = None, **options: Any) -> SlicerSteering:
    """Holds a view's volume rendering to its expected frame rate while it is moved.

    Volumes that are shown later join, those that are hidden leave; presets, regions of interest and changes of the
    rendering method are followed. Still frames are Slicer's, pixel for pixel.

    Parameters
    ----------
    view : qMRMLThreeDView or qMRMLThreeDWidget, a view of trame-slicer, vtkMRMLDisplayableManagerGroup or
        vtkMRMLVolumeRenderingDisplayableManager
        With its view node and its renderer.
    seconds : float, optional
        Seconds per frame, instead of 1 / the view node's ``ExpectedFPS``, which is followed.
    **options
        As :func:`entire.vtk.hold` takes them.

    Returns
    -------
    SlicerSteering

    Raises
    ------
    ValueError
        Where the view has no volume rendering, no view node or no renderer.

    Examples
    --------
    >>> view = slicer.app.layoutManager().threeDWidget(0).threeDView()         # doctest: +SKIP
    >>> steering = entire.slicer.hold(view)                                    # doctest: +SKIP
    """
    manager = _manager(view)
    if manager is None:
        raise ValueError(
            f"view is a {type(view).__name__} without a {_MANAGER}; pass a qMRMLThreeDView, a "
            f"vtkMRMLDisplayableManagerGroup that has one, or that manager itself"
        )
    node = manager.GetMRMLViewNode()
    if node is None or manager.GetRenderer() is None:
        raise ValueError(f"the {_MANAGER} has no view node or no renderer yet; hold the view when it is shown")
    return SlicerSteering(manager, node, seconds, **options)


__all__ = ["SlicerSteering", "hold"]
