# SPDX-License-Identifier: MIT OR Apache-2.0
"""Holds the volume rendering of 3D Slicer's views to the expected frame rate of the view node.

In Slicer::

    steering = entire.slicer.hold(slicer.app.layoutManager().threeDWidget(0).threeDView())

With trame-slicer, use ``entire.slicer.hold(view)``; with ``slicer-core`` alone, which has no views,
``entire.slicer.hold(manager)``.
"""

from __future__ import annotations

from typing import Any

from .vtk import Steering
from .vtk._weak import weak

_MANAGER = "vtkMRMLVolumeRenderingDisplayableManager"
# VolumeRenderingQuality "Maximum" of vtkMRMLViewNode: full quality, however long a frame takes.
_MAXIMUM = 2


class SlicerSteering(Steering):
    """Steering of a view's volumes. Made by :func:`hold`.

    The target follows the view node's expected frame rate. Nothing is steered while the node's quality is "Maximum".
    """

    def __init__(self, manager: Any, node: Any, seconds: float | None, **options: Any) -> None:
        self._node = weak(node)
        self._node_tag = 0
        self._fixed = seconds is not None
        self._maximum = False
        super().__init__(manager.GetRenderer(), None, _expected(node) if seconds is None else seconds, **options)
        self._node_tag = node.AddObserver("ModifiedEvent", self._on_node)
        self._on_node(node, "")

    def detach(self) -> None:
        """Releases the view and restores Slicer's settings of the mappers."""
        node = self._node()
        if node is not None and self._node_tag:
            node.RemoveObserver(self._node_tag)
        self._node_tag = 0
        super().detach()

    def _on_node(self, node: Any, _event: str) -> None:
        if not self._fixed:
            self.seconds = _expected(node)
        maximum = node.GetVolumeRenderingQuality() == _MAXIMUM
        if maximum != self._maximum:
            # Only a change of the quality sets `enabled`, so that other changes of the node keep the user's value.
            self._maximum, self.enabled = maximum, not maximum

    def _is_still(self, window: Any) -> bool:
        interactor = window.GetInteractor()
        if self._still or self.always is not None or interactor is None:
            return super()._is_still(window)
        # The rate that Slicer requests from VTK is lower than the node's expected rate: less than 1 frame per second if
        # less than 5 are expected. So the interactor's rate for still frames decides here, not `still_rate`.
        return bool(window.GetDesiredUpdateRate() <= interactor.GetStillUpdateRate())


def _expected(node: Any) -> float:
    return 1.0 / max(float(node.GetExpectedFPS()), 1e-4)


def _manager(view: Any) -> Any:
    """The displayable manager of volume rendering for an argument of :func:`hold`; None if the argument has none."""
    if hasattr(view, "threeDView"):
        view = view.threeDView()
    # Methods of a view of Slicer, of a view of trame-slicer, and of a group of managers.
    for name in "displayableManagerByClassName", "get_displayable_manager_by_class", "GetDisplayableManagerByClassName":
        if hasattr(view, name):
            return getattr(view, name)(_MANAGER)
    return view if hasattr(view, "IsA") and view.IsA(_MANAGER) else None


def hold(view: Any, *, seconds: float | None = None, **options: Any) -> SlicerSteering:
    """Holds a view's volume rendering to its expected frame rate while the view is moved.

    Volumes that are shown later are held too, and hidden ones released. Changes of presets, regions of interest and the
    rendering method take effect in the next frame. Slicer draws still frames with the same pixels as without steering.

    Parameters
    ----------
    view : qMRMLThreeDView or qMRMLThreeDWidget, a view of trame-slicer, vtkMRMLDisplayableManagerGroup or
        vtkMRMLVolumeRenderingDisplayableManager
        The view; it must have its view node and its renderer.
    seconds : float, optional
        Seconds per frame. Default: 1 / the view node's current ``ExpectedFPS``.
    **options
        Options of :func:`entire.vtk.hold`.

    Returns
    -------
    SlicerSteering

    Raises
    ------
    ValueError
        If the view has no volume rendering, no view node or no renderer.

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
