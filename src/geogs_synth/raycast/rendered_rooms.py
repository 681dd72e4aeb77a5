"""Results of casting rays at batches of rooms, on the CPU and by CUDA."""

from dataclasses import dataclass

from jaxtyping import Bool, Float, Int
from torch import Tensor

MARGIN = 1.5e-3
"""Metres before a point in which hits are ignored, since the point lies on a solid itself."""


@dataclass(frozen=True)
class RenderedRooms:
    """Rendered views of rooms."""

    colour: Float[Tensor, "b v 3 h w"]
    """Linear, the mean of four samples per pixel."""
    depth: Float[Tensor, "b v h w"]
    """z along the optical axis in metres, of the ray through the pixel's centre."""
    normal: Float[Tensor, "b v 3 h w"]
    """Unit, camera frame, facing the camera, of the surface that this ray meets."""
    solid: Int[Tensor, "b v h w"]
    """Index of the solid that this ray meets; -1 for the room itself."""


@dataclass(frozen=True)
class FlowTruth:
    """Pixels of points in a view, and their visibility."""

    pixels: Float[Tensor, "b h w 2"]
    """x, y."""
    visible: Bool[Tensor, "b h w"]
    """In the image, and nothing hides it there."""
    valid: Bool[Tensor, "b h w"]
    """In front of the camera; elsewhere the pixels mean nothing."""
