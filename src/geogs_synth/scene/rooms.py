"""What a batch of random rooms is made of.

World frame: z up, metres; a room fills [0, size]. A solid has a local frame and three numbers
``half`` whose meaning depends on its kind, as in :mod:`geogs_synth.scene.scene`.

Surfaces: 0..5 are the room's faces -x, +x, -y, +y, -z (floor), +z (ceiling); solid i has surface
6 + 2 i around it and 7 + 2 i on its two faces along the local z axis (an ellipsoid only the first).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.gpu.transfer import to_device

NONE, BOX, FRUSTUM, ELLIPSOID = -1, 0, 1, 2

Part = TypeVar("Part")


@dataclass(frozen=True)
class Solids:
    """The solids of b rooms, n places each."""

    kind: Int[Tensor, "b n"]
    """BOX, FRUSTUM, ELLIPSOID, or NONE where a place is empty."""
    rotation: Float[Tensor, "b n 3 3"]
    """Local to world."""
    centre: Float[Tensor, "b n 3"]
    """World, metres."""
    half: Float[Tensor, "b n 3"]
    """Metres, by kind."""

    @property
    def bounding_half(self) -> Float[Tensor, "b n 3"]:
        """Half extents of the bounding box in the local frame."""
        radius = torch.maximum(self.half[..., 0], self.half[..., 1])
        frustum = torch.stack([radius, radius, self.half[..., 2]], -1)
        return torch.where((self.kind == FRUSTUM)[..., None], frustum, self.half)

    def at(self, places: Int[Tensor, "k"]) -> "Solids":
        """Some of the places of every room."""
        return Solids(*(getattr(self, f.name)[:, places] for f in fields(Solids)))

    def without(self, gone: Bool[Tensor, "b n"]) -> "Solids":
        """The same places, some emptied."""
        return replace(self, kind=torch.where(gone, NONE, self.kind))

    def moved_by(self, ways: Float[Tensor, "b n 3"], steps: int | Tensor) -> "Solids":
        """What moves by ``ways`` per step, that many steps later."""
        return replace(self, centre=self.centre + steps * ways)

    @staticmethod
    def join(parts: Sequence["Solids"]) -> "Solids":
        """All places of several sets, one after the other."""
        names = [f.name for f in fields(Solids)]
        return Solids(*(torch.cat([getattr(p, name) for p in parts], 1) for name in names))


@dataclass(frozen=True)
class Surfaces:
    """How the s surfaces of b rooms look.

    The colour at a point with metric surface coordinates u is, in display values, ``tint *
    (0.5 + contrast * (texture(matrix u + offset) - 0.5)) * (1 + 2 detail * (noise - 0.5))``, where
    the noise is the green channel of a second texture; its square is the albedo.
    """

    texture: Int[Tensor, "b s"]
    """Index into the bank."""
    matrix: Float[Tensor, "b s 2 2"]
    """Repeats of the texture per metre; turned or mirrored, but scaled evenly."""
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
        """What the kernels read, in their order."""
        columns = [
            self.texture[..., None], self.matrix.flatten(-2), self.offset, self.contrast[..., None],
            self.tint, torch.stack([self.noise.float(), self.noise_scale, self.detail, self.gloss,
                                    self.shininess, self.glow, self.mirror], -1),
            torch.zeros_like(self.offset),
        ]  # fmt: skip
        return torch.cat([c.float() for c in columns], -1).contiguous()


@dataclass(frozen=True)
class Lights:
    """Light of each of v views: l balls and what comes from everywhere."""

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
        """What the kernels read: ambient above and below, then 8 numbers for each light."""
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
    solids: Solids
    surfaces: Surfaces
    lights: Lights


def packed_solids(solids: Solids) -> Float[Tensor, "b n 16"]:
    """What the kernels read: world-to-local rotation by rows, centre, half, kind."""
    rotation = solids.rotation.transpose(-1, -2).flatten(-2)
    rows = [rotation, solids.centre, solids.half, solids.kind[..., None]]
    return torch.cat([r.float() for r in rows], -1).contiguous()


def moved(part: Part, device: torch.device) -> Part:
    """Rooms, or a part of them, on a device, without waiting for it."""
    return _each(part, lambda t: to_device(t.contiguous(), device))


def only(part: Part, room: int) -> Part:
    """One room, or a part of it, as a batch of its own."""
    return _each(part, lambda t: t[room : room + 1])


def chosen(which: Bool[Tensor, "b"], first: Part, second: Part) -> Part:
    """Of each room what ``first`` says, or ``second``; rooms or parts of them."""
    values = [(getattr(first, f.name), getattr(second, f.name)) for f in fields(first)]  # type: ignore[arg-type]
    return type(first)(
        *(
            torch.where(which.reshape(-1, *[1] * (a.ndim - 1)), a, b)
            if isinstance(a, Tensor)
            else chosen(which, a, b)
            for a, b in values
        )
    )


def room_per_view(rooms: Rooms, views: int, ways: Float[Tensor, "b n 3"]) -> Rooms:
    """A room for each view, with what moves by ``ways`` from view to view where it is then."""

    def repeated(part: Part) -> Part:
        return _each(part, lambda t: t.repeat_interleave(views, 0))

    step = torch.arange(views, device=ways.device).repeat(len(ways))[:, None, None]
    solids = repeated(rooms.solids).moved_by(ways.repeat_interleave(views, 0), step)
    lights = _each(rooms.lights, lambda t: t.flatten(0, 1)[:, None])
    return Rooms(rooms.size.repeat_interleave(views, 0), solids, repeated(rooms.surfaces), lights)


def _each(part: Part, change: Callable[[Tensor], Tensor]) -> Part:
    """A dataclass of tensors, or of such dataclasses, with every tensor changed."""
    values = [getattr(part, f.name) for f in fields(part)]  # type: ignore[arg-type]
    return type(part)(
        *(
            change(v) if isinstance(v, Tensor) else _each(v, change) if is_dataclass(v) else v
            for v in values
        )
    )
