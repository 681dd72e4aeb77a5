"""What the compiled backends of the renderer have in common."""

from collections.abc import Callable, Sequence

from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.world.disks import DiskParameters

Backward = Callable[[Sequence[Tensor | None], bool], tuple[DiskParameters, Tensor | None]]
"""From the gradients of the maps, None for zero, to those of the disks and, if asked, the pose."""
Forward = Callable[
    [DiskParameters, Camera, Tensor, float, bool], tuple[tuple[Tensor, ...], Backward]
]
"""From disks, camera, pose, least depth, and whether gradients are asked for, to the maps, as a
``RenderOutput`` has them, and what takes their gradients back."""
