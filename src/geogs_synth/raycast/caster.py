"""What casters of rays at batches of rooms do; one for the CPU, one for CUDA."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs_synth.camera.camera_batch import CameraBatch
from geogs_synth.raycast.rays import Hit
from geogs_synth.scene.rooms import Rooms
from geogs_synth.scene.solids import SolidBatch
from geogs_synth.textures.pyramids import TextureBank

MARGIN = 1.5e-3
"""Metres before a point within which nothing hides it, since it lies on a solid itself."""


@dataclass(frozen=True)
class RenderedRooms:
    """What views see."""

    colour: Float[Tensor, "b v 3 h w"]
    """Linear, the mean of four samples per pixel."""
    depth: Float[Tensor, "b v h w"]
    """z along the optical axis in metres, of the ray through the pixel's centre."""
    normal: Float[Tensor, "b v 3 h w"]
    """Unit, camera frame, facing the camera, of the surface that this ray meets."""
    solid: Int[Tensor, "b v h w"]
    """Place of the solid that it meets; -1 for the room itself."""


@dataclass(frozen=True)
class FlowTruth:
    """Where points are in a view."""

    pixels: Float[Tensor, "b h w 2"]
    """x, y."""
    visible: Bool[Tensor, "b h w"]
    """In the image, and nothing hides it there."""
    valid: Bool[Tensor, "b h w"]
    """In front of the camera; elsewhere the pixels mean nothing."""


@runtime_checkable
class RoomCaster(Protocol):
    """Casts rays at batches of rooms."""

    def render(self, rooms: Rooms, bank: TextureBank, views: CameraBatch) -> RenderedRooms:
        """What every view sees."""
        ...

    def flow(
        self, solids: SolidBatch, views: CameraBatch, points: Float[Tensor, "b h w 3"], view: int
    ) -> FlowTruth:
        """Where points of the world are in a view."""
        ...

    def first_hit(
        self, size: Float[Tensor, "b 3"], solids: SolidBatch, origin: Float[Tensor, "b m 3"],
        direction: Float[Tensor, "b m 3"],
    ) -> Hit:  # fmt: skip
        """The first thing that each ray from inside a room meets."""
        ...
