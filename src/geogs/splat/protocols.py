"""Types of the renderer's compiled passes."""

from collections.abc import Callable, Sequence

from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.world.disks import DiskParameters

Backward = Callable[[Sequence[Tensor | None], bool], tuple[DiskParameters, Tensor | None]]
"""Function of the maps' gradients, None for zero: those of the disks and, on request, the pose."""
Forward = Callable[
    [DiskParameters, Camera, Tensor, float, bool], tuple[tuple[Tensor, ...], Backward]
]
"""Function of disks, camera, pose, least depth, and whether gradients are needed: the maps, as in
``RenderOutput``, and their backward pass."""
