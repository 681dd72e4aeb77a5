"""What stands where in random rooms."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs_synth.clips import loose, pieces
from geogs_synth.clips.pieces import BOARDS, Placed
from geogs_synth.draw import Draw, about_z
from geogs_synth.scene.rooms import NONE, Solids


@dataclass(frozen=True)
class Layout:
    """Solids of b rooms, and which of the n places belong together."""

    solids: Solids
    material: Int[Tensor, "n"]
    """The place whose surfaces a place shares; its own for most."""
    picture: Bool[Tensor, "n"]
    """Whether it hangs flat on a wall and shows an image."""


@dataclass(frozen=True)
class _Group:
    """Places that are filled in the same way."""

    solids: Solids
    shares: int
    """So many consecutive places have one material."""
    picture: int = 0
    """Every so many-th place is a picture; 0 for none."""


def draw_layout(draw: Draw, size: Float[Tensor, "b 3"], least: float, most: float) -> Layout:
    """Furnishes rooms of these sizes; the densities are those of :class:`RoomOptions`."""
    b = len(size)
    share = draw.uniform(least, most, b)[:, None]
    cupboards = pieces.cupboards(draw, size, 8)
    tables = pieces.tables(draw, size, 3)
    shelves = pieces.shelves(draw, size, 2)
    standing = [
        draw.uniform(0, 1, *placed[1].yaw.shape) < share for placed in (cupboards, tables, shelves)
    ]
    floor = loose.floor(size)
    supports = [(cupboards, standing[0], 0), (tables, standing[1], 0)]
    supports += [(shelves, standing[2], k) for k in range(BOARDS)]
    # What would stand on a piece that is not there stands on the floor.
    furniture = torch.cat(
        [torch.where(there[..., None], pieces.tops(p, k), floor) for p, there, k in supports], 1
    )
    anywhere = torch.cat([floor.expand(-1, 6, -1), furniture], 1)

    def some(placed: Placed) -> Solids:
        return _put(placed, draw.uniform(0, 1, *placed[1].yaw.shape) < share)

    def scattered(solids: Solids, factor: float = 1.0) -> Solids:
        return solids.without(draw.uniform(0, 1, *solids.kind.shape) > factor * share)

    return _join(
        _Group(_put(cupboards, standing[0]), 1),
        _Group(_put(tables, standing[1]), 5),
        _Group(some(pieces.chairs(draw, size, 2)), 6),
        _Group(some(pieces.sofas(draw, size, 1)), 4),
        _Group(_put(shelves, standing[2]), BOARDS + 2),
        _Group(some(pieces.pictures(draw, size, 7)), 1, picture=2),
        _Group(_put(pieces.skirting(draw, size), draw.chance(0.6, b, 1)), 4),
        _Group(some(pieces.lamps(draw, size, 2)), 1),
        _Group(some(pieces.plants(draw, size, 1)), 8),
        _Group(some(loose.books(draw, furniture, 3)), 1),
        _Group(scattered(loose.clutter(draw, anywhere, 20), 1.2), 1),
        _Group(scattered(loose.wires(draw, size, 5)), 1),
        _Group(scattered(loose.turned(draw, size, 4), 0.6), 1),
    )


def _put(placed: Placed, there: Bool[Tensor, "b k"]) -> Solids:
    """The solids of pieces in their places; some of the pieces are not there."""
    piece, place = placed
    turn = about_z(place.yaw)[:, :, None]
    centre = (turn @ piece.centre[..., None])[..., 0] + place.position[:, :, None]
    kind = torch.where(there[..., None], piece.kind, NONE)
    rotation = turn @ piece.rotation
    half = piece.half.flatten(1, 2)
    return Solids(kind.flatten(1), rotation.flatten(1, 2), centre.flatten(1, 2), half)


def _join(*groups: _Group) -> Layout:
    material: list[int] = []
    picture: list[bool] = []
    for group in groups:
        start, count = len(material), group.solids.kind.shape[1]
        material += [start + k - k % group.shares for k in range(count)]
        picture += [group.picture > 0 and k % group.picture == 0 for k in range(count)]
    solids = Solids.join([g.solids for g in groups])
    return Layout(solids, torch.tensor(material), torch.tensor(picture))
