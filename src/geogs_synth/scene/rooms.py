"""Batches of random rooms for training: solids, surfaces, lights.

A room fills [0, size]. Surfaces: 0..5 are the room's faces -x, +x, -y, +y, -z (floor), +z
(ceiling); solid i has surface 6 + 2 i around it and 7 + 2 i on its two faces along the local z axis
(an ellipsoid only the first).
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs_synth.scene.batch import gather, map_tensors
from geogs_synth.scene.solids import NONE, SolidBatch

MOST_SOLIDS = 128
"""Most solids in a room that the kernels take."""


@dataclass(frozen=True)
class Surfaces:
    """Appearance of the s surfaces of b rooms.

    The colour at a point with metric surface coordinates u is, in display values, ``tint *
    (0.5 + contrast * (texture(matrix u + offset) - 0.5)) * (1 + 2 detail * (noise - 0.5))``, where
    the noise is the green channel of a second texture; its square is the albedo.
    """

    texture: Int[Tensor, "b s"]
    """Index into the bank."""
    matrix: Float[Tensor, "b s 2 2"]
    """Repeats of the texture per metre; rotated or mirrored, but scaled evenly."""
    offset: Float[Tensor, "b s 2"]
    """Repeats."""
    contrast: Float[Tensor, "b s"]
    """0 leaves a plain colour."""
    tint: Float[Tensor, "b s 3"]
    """Factor on the colour; a plain white surface has about 1.8."""
    noise: Int[Tensor, "b s"]
    """Index of the second texture."""
    noise_scale: Float[Tensor, "b s"]
    """Repeats of the second texture per metre."""
    detail: Float[Tensor, "b s"]
    """Strength of the second texture."""
    gloss: Float[Tensor, "b s"]
    """Strength of the highlights; 0 for a matt surface."""
    shininess: Float[Tensor, "b s"]
    """Exponent of the highlights."""
    glow: Float[Tensor, "b s"]
    """Light of its own, times the albedo."""
    mirror: Float[Tensor, "b s"]
    """Reflects the room: 0 for most, near 1 for a mirror; more at grazing angles."""

    def packed(self) -> Float[Tensor, "b s 20"]:
        """Kernel input, in the kernels' order."""
        columns = [
            self.texture[..., None], self.matrix.flatten(-2), self.offset, self.contrast[..., None],
            self.tint, torch.stack([self.noise.float(), self.noise_scale, self.detail, self.gloss,
                                    self.shininess, self.glow, self.mirror], -1),
            torch.zeros_like(self.offset),
        ]  # fmt: skip
        return torch.cat([c.float() for c in columns], -1).contiguous()


@dataclass(frozen=True)
class Lights:
    """Light of each of v views: l balls and ambient light."""

    position: Float[Tensor, "b v l 3"]
    """World, metres."""
    colour: Float[Tensor, "b v l 3"]
    """Irradiance at about one metre, linear; black where there is no such light."""
    radius: Float[Tensor, "b v l"]
    """Metres; larger casts softer shadows."""
    above: Float[Tensor, "b v 3"]
    """Ambient irradiance of surfaces facing up."""
    below: Float[Tensor, "b v 3"]
    """Ambient irradiance of surfaces facing down."""

    def packed(self) -> Float[Tensor, "b v n"]:
        """Kernel input: ambient light from above and below, then 8 numbers for each light."""
        zero = torch.zeros_like(self.radius)
        balls = torch.cat([self.position, self.colour, torch.stack([self.radius, zero], -1)], -1)
        ambient = torch.cat([self.above, self.below], -1)
        zeros = torch.zeros_like(self.above[..., :2])
        return torch.cat([ambient, zeros, balls.flatten(-2)], -1).float().contiguous()


@dataclass(frozen=True)
class Rooms:
    """b rooms and the light in which each of v views sees them."""

    size: Float[Tensor, "b 3"]
    """Metres."""
    solids: SolidBatch
    surfaces: Surfaces
    lights: Lights

    def with_places(self, most: int) -> "Rooms":
        """Keep at most ``most`` slots for solids: empty ones are removed first, then the last."""
        kind = self.solids.kind
        if kind.shape[1] <= most:
            return self
        kept = (kind == NONE).long().sort(dim=1, stable=True).indices[:, :most]
        faces = torch.stack([2 * kept + 6, 2 * kept + 7], -1).flatten(1)
        walls = torch.arange(6, device=kind.device).expand(len(kind), 6)
        surfaces = gather(self.surfaces, torch.cat([walls, faces], 1))
        return replace(self, solids=gather(self.solids, kept), surfaces=surfaces)


def packed_solids(solids: SolidBatch) -> Float[Tensor, "b n 16"]:
    """Kernel input: world-to-local rotation by rows, centre, half, kind."""
    rotation = solids.rotation.transpose(-1, -2).flatten(-2)
    rows = [rotation, solids.centre, solids.half, solids.kind[..., None]]
    return torch.cat([r.float() for r in rows], -1).contiguous()


def room_per_view(rooms: Rooms, views: int, velocity: Float[Tensor, "b n 3"]) -> Rooms:
    """A room for each view, with solids moved by ``velocity`` (metres per view) up to it."""

    def repeat(tensor: Tensor) -> Tensor:
        return tensor.repeat_interleave(views, 0)

    step = torch.arange(views, device=velocity.device).repeat(len(velocity))[:, None, None]
    solids = map_tensors(repeat, rooms.solids).moved_by(repeat(velocity), step)
    lights = map_tensors(lambda t: t.flatten(0, 1)[:, None], rooms.lights)
    return Rooms(repeat(rooms.size), solids, map_tensors(repeat, rooms.surfaces), lights)
