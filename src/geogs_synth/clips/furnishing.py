"""Furniture and other objects in random rooms, and their poses."""

from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs_synth.clips import pieces
from geogs_synth.clips.pieces import BOARDS, StandingPiece
from geogs_synth.draw import Draw, about_z
from geogs_synth.scene.solids import NONE, SolidBatch, Solids


@dataclass(frozen=True)
class Furnishing:
    """n solids of b rooms, and which of them belong together."""

    solids: SolidBatch
    material: Int[Tensor, "n"]
    """Index of the solid whose surfaces a solid shares; its own for most."""
    picture: Bool[Tensor, "n"]
    """Whether a solid hangs flat on a wall and shows an image."""


@dataclass(frozen=True)
class _Group:
    """Solids of pieces of one kind."""

    solids: SolidBatch
    per_material: int
    """Number of consecutive solids of one material."""
    picture: int = 0
    """Distance from picture to picture in the list of solids; 0 for none."""


def draw_furnishing(
    draw: Draw, size: Float[Tensor, "b 3"], least: float, most: float, thin: float = 0.0
) -> Furnishing:
    """Furnish rooms of these sizes; the densities are those of :class:`RoomOptions`.

    With thin things there are twice as many slots for solids."""
    b = len(size)
    density = draw.uniform(least, most, b)[:, None]
    cupboards = pieces.cupboards(draw, size, 8)
    tables = pieces.tables(draw, size, 3)
    shelves = pieces.shelves(draw, size, 2)
    furniture = (cupboards, tables, shelves)
    standing = [_drawn(draw, placed, density) for placed in furniture]
    floor = pieces.floor(size)
    supports = [(cupboards, standing[0], 0), (tables, standing[1], 0)]
    supports += [(shelves, standing[2], k) for k in range(BOARDS)]
    # Things that would stand on a missing piece stand on the floor.
    faces = torch.cat(
        [torch.where(there[..., None], pieces.tops(p, k), floor) for p, there, k in supports], 1
    )
    anywhere = torch.cat([floor.expand(-1, 6, -1), faces], 1)

    some = partial(_some, draw, density)

    def scattered(solids: SolidBatch, factor: float = 1.0) -> SolidBatch:
        return solids.without(draw.uniform(0, 1, *solids.kind.shape) > factor * density)

    groups = [
        _Group(_put(cupboards, standing[0]), 1),
        _Group(_put(tables, standing[1]), 5),
        _Group(some(pieces.chairs(draw, size, 2)), 6),
        _Group(some(pieces.sofas(draw, size, 1)), 4),
        _Group(_put(shelves, standing[2]), BOARDS + 2),
        _Group(some(pieces.pictures(draw, size, 7)), 1, picture=2),
        _Group(_put(pieces.skirting(draw, size), draw.chance(0.6, b, 1)), 4),
        _Group(some(pieces.lamps(draw, size, 2)), 1),
        _Group(some(pieces.plants(draw, size, 1)), 8),
        _Group(some(pieces.books(draw, faces, 3)), 1),
        _Group(scattered(pieces.clutter(draw, anywhere, 20), 1.2), 1),
        _Group(scattered(pieces.wires(draw, size, 5)), 1),
        _Group(scattered(pieces.slabs(draw, size, 4), 0.6), 1),
    ]
    return _join(*groups, *(_thin_things(draw, size, thin) if thin > 0 else ()))


def _thin_things(draw: Draw, size: Float[Tensor, "b 3"], most: float) -> tuple[_Group, ...]:
    """Railings, lattices, cables, bushes and more chairs: none in some rooms, many in others."""
    density = draw.uniform(0, most, len(size))[:, None]
    some = partial(_some, draw, density)
    cables = pieces.cables(draw, size, 3)
    gone = draw.uniform(0, 1, len(size), 3) > density
    cables = cables.without(gone.repeat_interleave(pieces.SEGMENTS, 1))
    return (
        _Group(some(pieces.railings(draw, size, 2)), pieces.BALUSTERS + 2),
        _Group(some(pieces.lattices(draw, size, 2)), 2 * pieces.BARS),
        _Group(cables, pieces.SEGMENTS),
        _Group(some(pieces.bushes(draw, size, 2)), pieces.TWIGS),
        _Group(some(pieces.chairs(draw, size, 3)), 6),
        _Group(some(pieces.tables(draw, size, 1)), 5),
    )


def _drawn(draw: Draw, placed: StandingPiece, density: Float[Tensor, "b 1"]) -> Bool[Tensor, "b k"]:
    """Mask of the pieces that are there, at random."""
    return draw.uniform(0, 1, *placed[1].yaw.shape) < density


def _some(draw: Draw, density: Float[Tensor, "b 1"], placed: StandingPiece) -> SolidBatch:
    """The solids of pieces, some of which are left out at random."""
    return _put(placed, _drawn(draw, placed, density))


def _put(placed: StandingPiece, there: Bool[Tensor, "b k"]) -> SolidBatch:
    """The solids of pieces at their poses; those that are not ``there`` are empty."""
    piece, place = placed
    R = about_z(place.yaw)[:, :, None]
    centre = (R @ piece.centre[..., None])[..., 0] + place.position[:, :, None]
    kind = torch.where(there[..., None], piece.kind, NONE)
    return Solids(kind, R @ piece.rotation, centre, piece.half).flatten()


def _join(*groups: _Group) -> Furnishing:
    material: list[int] = []
    picture: list[bool] = []
    for group in groups:
        start = len(material)
        count = group.solids.kind.shape[1]
        material += [start + k - k % group.per_material for k in range(count)]
        picture += [group.picture > 0 and k % group.picture == 0 for k in range(count)]
    solids = Solids.join([g.solids for g in groups])
    return Furnishing(solids, torch.tensor(material), torch.tensor(picture))
