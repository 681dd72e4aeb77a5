"""Types of the renderer's compiled passes."""

from collections.abc import Callable, Sequence

from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.world.disks import DiskParameters

Backward = Callable[[Sequence[Tensor | None], bool], tuple[DiskParameters, Tensor | None]]
"""From gradients of the maps, None for zero, to those of the disks and, on request, of the pose."""
Forward = Callable[
    [DiskParameters, Camera, Tensor, float, bool], tuple[tuple[Tensor, ...], Backward]
]
"""From disks, camera, pose, least depth, and whether gradients are needed, to the maps, as in
``RenderOutput``, and their backward pass."""
