"""Objects with parts thinner than the gaps between them: railings, lattices, cables, twigs."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from geogs_synth.clips.pieces import FloorPose, Numbers, StandingPiece, boxes, stand
from geogs_synth.draw import Draw
from geogs_synth.scene.batch import where
from geogs_synth.scene.solids import FRUSTUM, SolidBatch, Solids

BALUSTERS, BARS, SEGMENTS, TWIGS = 12, 5, 5, 12
"""Numbers of parts of a railing, of a lattice in each direction, of a cable, of a bush."""


def railings(draw: Draw, size: Float[Tensor, "b 3"], count: int) -> StandingPiece:
    """Balusters, round or square, between two rails: on the floor, or hung like a shutter."""
    n = (len(size), count)
    w, tall = draw.log_uniform(0.25, 1.2, *n), draw.log_uniform(0.15, 0.6, *n)
    thin, rail = draw.log_uniform(0.003, 0.025, *n), draw.log_uniform(0.008, 0.04, *n)
    places = torch.linspace(-1, 1, BALUSTERS).tolist()
    upright = boxes(*((x * (w - thin), 0 * w, tall, thin, thin, tall) for x in places))
    kind = torch.where(draw.chance(0.5, *n)[..., None], FRUSTUM, upright.kind)
    rails = boxes(*((0 * w, 0 * w, z * tall, w, rail, 0.7 * rail) for z in (0.1, 2.0)))
    piece = Solids.join([rails, replace(upright, kind=kind)])
    return piece, _lifted(draw, size, stand(draw, size, torch.stack([w, rail], -1), 0.15), tall)


def lattices(draw: Draw, size: Float[Tensor, "b 3"], count: int) -> StandingPiece:
    """Bars that cross: grids, window bars, racks, shelves without backs; some lie flat."""
    n = (len(size), count)
    w, tall = draw.log_uniform(0.1, 0.8, *n), draw.log_uniform(0.1, 0.8, *n)
    thin, deep = draw.log_uniform(0.003, 0.02, *n), draw.log_uniform(0.003, 0.12, *n)
    flat = draw.chance(0.2, *n)
    rows = []
    for p in torch.linspace(-1, 1, BARS).tolist():
        rows.append((p * w, 0 * w, tall, thin, deep, tall))
        rows.append((0 * w, 0 * w, tall + p * tall, w, deep, thin))
    piece = boxes(*rows)
    lying = replace(piece, centre=piece.centre[..., [0, 2, 1]], half=piece.half[..., [0, 2, 1]])
    place = stand(draw, size, torch.stack([w, torch.where(flat, tall, deep)], -1), 0.2)
    return where(flat, lying, piece), _lifted(draw, size, place, tall)


def cables(draw: Draw, size: Float[Tensor, "b 3"], count: int) -> SolidBatch:
    """Cables and ropes that sag between two points anywhere in the room."""
    n = (len(size), count)
    ends = draw.uniform(0.02, 0.98, *n, 2, 3) * size[:, None, None]
    along = torch.linspace(0, 1, SEGMENTS + 1)[:, None]
    points = torch.lerp(ends[:, :, :1], ends[:, :, 1:], along)
    sag = (4 * along * (1 - along)) * draw.log_uniform(0.01, 0.6, *n)[..., None, None]
    points = points - sag * torch.tensor([0.0, 0.0, 1.0])
    points[..., 2] = points[..., 2].clamp_min(0.01)
    radius = draw.log_uniform(0.002, 0.02, *n)[..., None].expand(*n, SEGMENTS)
    step = torch.diff(points, dim=2)
    half = torch.stack([radius, radius, 0.5 * step.norm(dim=-1) + 0.5 * radius], -1)
    centre = 0.5 * (points[:, :, 1:] + points[:, :, :-1])
    kind = torch.full((*n, SEGMENTS), FRUSTUM)
    return Solids(kind, _along(step), centre, half).flatten()


def bushes(draw: Draw, size: Float[Tensor, "b 3"], count: int) -> StandingPiece:
    """Randomly rotated twigs, leaves or flat sticks around a point above the floor."""
    n = (len(size), count)
    reach = draw.log_uniform(0.08, 0.5, *n)[..., None]
    length = reach * draw.uniform(0.3, 1.0, *n, TWIGS)
    wide = draw.log_uniform(0.002, 0.05, *n)[..., None].expand(*n, TWIGS)
    thick = wide * draw.uniform(0.2, 1.0, *n)[..., None]
    kind = draw.choose((0.3, 0.4, 0.3), *n)[..., None].expand(*n, TWIGS)  # box, frustum, ellipsoid
    # A frustum's first two numbers are the radii of its ends.
    half = torch.stack([wide, torch.where(kind == FRUSTUM, 0.5 * wide, thick), length], -1)
    centre = reach[..., None] * draw.normal(0.45, *n, TWIGS, 3)
    middle = draw.uniform(0.1, 1.0, *n)[..., None] * (size[:, None, 2:] - 0.2)
    centre[..., 2] = centre[..., 2] + middle
    piece = Solids(kind, draw.rotation(*n, TWIGS), centre, half)
    return piece, stand(draw, size, reach.expand(*n, 2), 0.2)


def _lifted(draw: Draw, size: Float[Tensor, "b 3"], place: FloorPose, tall: Numbers) -> FloorPose:
    """Lift half of the pieces, which are 2 ``tall`` high, to a random height above the floor."""
    free = (size[:, 2:] - 2 * tall).clamp_min(0)
    lift = draw.chance(0.5, *tall.shape) * draw.uniform(0, 1, *tall.shape) * free
    return replace(place, position=place.position + functional.pad(lift[..., None], (2, 0)))


def _along(direction: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """Rotations that take z to directions."""
    z = functional.normalize(direction, dim=-1)
    aside = torch.where(
        (z[..., :1].abs() < 0.7), torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 1.0, 0.0])
    )
    x = functional.normalize(torch.linalg.cross(aside, z), dim=-1)
    return torch.stack([x, torch.linalg.cross(z, x), z], -1)
