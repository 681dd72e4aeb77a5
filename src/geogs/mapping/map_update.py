"""Moving the map after the trajectory was corrected: coherent, or per keyframe (the baseline).

Each disk has an anchor, the keyframe it was made from. The correction of its anchor would carry it
to a target position (Eq. target_position). Moving every disk to its own target tears surfaces that
several keyframes share; the coherent update fits one Sim(3) to all targets (Eq. global_sim3), and
where one Sim(3) cannot describe the correction, a smooth field of them.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.errors import GeogsError
from geogs.geometry.lie import se3_inverse, sim3_exp, sim3_log
from geogs.geometry.neighbors import nearest_neighbors
from geogs.geometry.umeyama import umeyama
from geogs.types import PoseCorrection

Strategy = Literal["coherent", "per_keyframe"]


@dataclass(frozen=True)
class MapUpdate:
    """How each disk moves, and how well one Sim(3) described it."""

    transform: Float[Tensor, "n 4 4"]
    """World similarity of each disk, float64."""
    correction: float
    """Root mean square distance between positions and targets, map units."""
    residual: float
    """Root mean square distance between targets and where the update puts the disks."""


def anchor_transforms(correction: PoseCorrection) -> tuple[Tensor, Tensor]:
    """Keyframe ids (sorted) and the world similarity each correction amounts to.

    The corrected pose T' already lives in corrected units, so a camera-frame point T mu is first
    divided by the scale and then taken back to the world: S = T'^-1 (1/scale) T. (As printed, the
    division comes last and scales about the world origin; see the paper's Eq. target_position.)
    """
    ids = sorted(correction.after)
    before = torch.stack([correction.before[i] for i in ids]).double()
    after = torch.stack([correction.after[i] for i in ids]).double()
    scale = torch.tensor([correction.scale.get(i, 1.0) for i in ids], dtype=torch.float64)
    shrink = torch.eye(4, dtype=torch.float64).repeat(len(ids), 1, 1)
    shrink[:, :3, :3] /= scale[:, None, None]
    return torch.tensor(ids), se3_inverse(after) @ shrink @ before


def apply_each(S: Float[Tensor, "n 4 4"], points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Every point by its own similarity."""
    return (S[:, :3, :3] @ points[:, :, None])[:, :, 0] + S[:, :3, 3]


def plan_update(
    position: Float[Tensor, "n 3"],
    anchor: Int[Tensor, "n"],
    correction: PoseCorrection,
    strategy: Strategy = "coherent",
    field_threshold: float = 0.25,
    nodes: int = 200,
) -> MapUpdate:
    """The similarity of every disk for a pose correction.

    Disks whose anchor is not in the correction follow the corrected keyframe nearest in time.
    ``coherent`` fits one Sim(3) to all targets; if what it leaves is more than ``field_threshold``
    of the correction, it is followed by a smooth field of Sim(3)s at ``nodes`` control points.
    """
    if len(position) == 0:
        return MapUpdate(torch.zeros(0, 4, 4, dtype=torch.float64), 0.0, 0.0)
    ids, similarities = anchor_transforms(correction)
    slot = torch.searchsorted(ids, anchor.cpu().to(ids.dtype)).clamp(max=len(ids) - 1)
    previous = (slot - 1).clamp(min=0)
    closer = (anchor.cpu() - ids[previous]).abs() < (ids[slot] - anchor.cpu()).abs()
    own = similarities[torch.where(closer, previous, slot)]
    x = position.detach().cpu().double()
    target = apply_each(own, x)
    moved = _rms(target - x)
    if strategy == "per_keyframe" or len(x) < 4:
        return MapUpdate(own, moved, 0.0)
    S = _fit_similarity(x, target)
    if S is None:
        return MapUpdate(own, moved, 0.0)
    left = _rms(target - apply_each(S.expand(len(x), 4, 4), x))
    if left <= field_threshold * moved or moved < 1e-9:
        return MapUpdate(S.expand(len(x), 4, 4).clone(), moved, left)
    field = similarity_field(x, target, S, nodes)
    return MapUpdate(field, moved, _rms(target - apply_each(field, x)))


def similarity_field(
    x: Float[Tensor, "n 3"], target: Float[Tensor, "n 3"], S: Float[Tensor, "4 4"], nodes: int
) -> Float[Tensor, "n 4 4"]:
    """A similarity for every point that follows the targets locally and varies smoothly.

    Control points are spread by farthest-point sampling. Each fits a Sim(3) to the points around
    it, weighted by a Gaussian of distance, from the similarity ``S`` onwards; a point takes the
    weighted mean of its nearest control points' remainders in the Lie algebra, so neighbours on
    one surface move alike whichever keyframe made them.
    """
    warped = apply_each(S.expand(len(x), 4, 4), x)
    centres = _farthest_points(warped, min(nodes, len(x)))
    spread, _ = nearest_neighbors(warped[centres], warped[centres], 5)
    radius = spread[:, 1:].mean(1).clamp(min=1e-9) * 1.5
    support = min(len(x), max(64, 8 * len(x) // len(centres)))
    distance, index = nearest_neighbors(warped[centres], warped, support)
    remainders = []
    for c in range(len(centres)):
        weight = torch.exp(-0.5 * (distance[c] / radius[c]) ** 2) + 1e-9
        local = _fit_similarity(warped[index[c]], target[index[c]], weight)
        remainders.append(torch.zeros(7).double() if local is None else sim3_log(local))
    distance, index = nearest_neighbors(warped, warped[centres], 8)
    weight = torch.exp(-0.5 * (distance / radius[index]) ** 2) + 1e-12
    weight = weight / weight.sum(1, keepdim=True)
    tangent = (weight[..., None] * torch.stack(remainders)[index]).sum(1)
    return sim3_exp(tangent) @ S


def _fit_similarity(source: Tensor, target: Tensor, weights: Tensor | None = None) -> Tensor | None:
    """Umeyama as a 4x4 matrix; None where the points do not determine one."""
    try:
        scale, R, t = umeyama(source, target, weights=weights)
    except GeogsError:
        return None
    S = torch.eye(4, dtype=torch.float64)
    S[:3, :3], S[:3, 3] = scale * R, t
    return S


def _farthest_points(x: Tensor, count: int) -> Tensor:
    """Indices of ``count`` points, each the farthest from those before it; deterministic."""
    chosen = torch.zeros(count, dtype=torch.long)
    chosen[0] = (x - x.mean(0)).square().sum(1).argmax()
    nearest = (x - x[chosen[0]]).square().sum(1)
    for i in range(1, count):
        chosen[i] = nearest.argmax()
        nearest = torch.minimum(nearest, (x - x[chosen[i]]).square().sum(1))
    return chosen


def _rms(difference: Tensor) -> float:
    return float(difference.square().sum(-1).mean().sqrt())
