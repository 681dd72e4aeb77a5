"""Moving the map after the trajectory was corrected: blended, coherent (the paper's), per keyframe.

Each disk has an anchor, the keyframe it was made from. The correction of its anchor would move it
to a target position (Eq. target_position). Moving every disk to its own target tears surfaces that
several keyframes share. The coherent update fits one Sim(3) to the targets of all disks whose
anchors move, the paper's revisited ones (Eq. global_sim3): it tears nothing among them and cannot
follow a drift. Where only part of the map is revisited and one Sim(3) does not describe how it
moves, it would tear the part from the rest, and each disk goes with its anchor. The blended update
moves every disk with all keyframes on whose depth it lies: they trained it, not only the one that
made it. Where a drifting loop has doubled a surface, each layer lies on the depths of its own visit
and moves with these. Then the similarities are smoothed between neighbours, but not across layers
that have to part.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.errors import GeogsError
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_inverse, sim3_exp, sim3_inverse, sim3_log
from geogs.geometry.neighbors import nearest_neighbors
from geogs.geometry.umeyama import umeyama
from geogs.gpu.transfer import to_device
from geogs.mapping.keyframe_views import MapView
from geogs.types import PoseCorrection

Strategy = Literal["blended", "coherent", "per_keyframe"]

MIN_MOTION = 1e-3
"""An anchor has moved if its disks move by more than this fraction of their distance to it."""
MAX_RESIDUAL = 0.5
"""Largest residual of the one Sim(3), as a fraction of the correction, where other disks stay."""
_AGREEMENT = 0.03
"""Relative standard deviation of disks around the depth of a keyframe whose surface they are on."""
_OWN = 0.1
"""Weight of the keyframe that made a disk; another's is at most one."""
_BORDER = 8.0
"""Pixels over which a keyframe's weight fades towards the border of its image."""
_NEIGHBOURS = 32
_ROUNDS = 4
_SPREAD = 1.5
"""Width of the smoothing, in units of the median distance to the neighbours."""
_PARTING = 0.2
"""Difference of the displacements of neighbours of different layers, in that width."""


@dataclass(frozen=True, eq=False)
class CovisibleKeyframe:
    """Depth of a keyframe before the correction, on the device of the map."""

    keyframe_id: int
    camera: Camera
    """Camera of the depth map."""
    T_cw: Float[Tensor, "4 4"]
    """World to camera, before the correction."""
    depth: Float[Tensor, "h w"]
    """z in map units, before the correction."""
    confidence: Float[Tensor, "h w"]
    """Confidence of the depth, in [0, 1]."""


def covisible_keyframe(view: MapView, correction: PoseCorrection) -> CovisibleKeyframe:
    """Depth and pose of a view before a correction that was applied to it."""
    dense = view.dense
    camera = view.arrays.cameras.render
    depth = dense.depth * correction.scale.get(view.id, 1.0)
    T_cw = correction.before.get(view.id, view.T_cw)
    return CovisibleKeyframe(view.id, camera, T_cw, depth, dense.confidence)


def anchor_transforms(correction: PoseCorrection) -> tuple[Tensor, Tensor]:
    """Keyframe ids (sorted) and the similarity of the world by which each moves.

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
    """Points, each moved by its own similarity."""
    return (S[:, :3, :3] @ points[:, :, None])[:, :, 0] + S[:, :3, 3]


def plan_update(
    position: Float[Tensor, "n 3"],
    anchor: Int[Tensor, "n"],
    correction: PoseCorrection,
    strategy: Strategy = "blended",
    covisible: Iterable[CovisibleKeyframe] = (),
) -> Float[Tensor, "n 4 4"]:
    """The world similarity (float64) of every disk for a pose correction, computed where the disks
    live.

    Disks whose anchor is not in the correction follow the corrected keyframe nearest in time.
    ``per_keyframe`` moves each with its anchor, ``coherent`` those whose anchors move by the one
    Sim(3) that fits their targets best (:func:`coherent_similarities`), ``blended`` each with the
    ``covisible`` keyframes on whose depth it lies (with its anchor if there is none), smoothed over
    neighbours; covisible keyframes that are not in the correction are ignored.
    """
    if len(position) == 0:
        return torch.zeros(0, 4, 4, dtype=torch.float64)
    ids, similarities = anchor_transforms(correction)
    slot = _nearest_in_time(ids, anchor.cpu()).to(position.device)
    own = similarities.to(position.device)[slot]
    x = position.detach().double()
    target = apply_each(own, x)
    if strategy == "coherent":
        return coherent_similarities(x, target, own, _revisited(x, target, slot, correction))
    if strategy == "blended" and (fit := _fit_similarity(x, target)) is not None:
        known = {int(i): n for n, i in enumerate(ids)}
        seen = ((k, known[k.keyframe_id]) for k in covisible if k.keyframe_id in known)
        return blended_similarities(x, own, fit, similarities, seen)
    return own


def coherent_similarities(
    x: Float[Tensor, "n 3"],
    target: Float[Tensor, "n 3"],
    own: Float[Tensor, "n 4 4"],
    revisited: Bool[Tensor, "n"],
) -> Float[Tensor, "n 4 4"]:
    """One Sim(3) for the revisited disks, fitted to their targets; the others stay.

    ``own``, the correction of each disk's anchor, where the revisited disks determine no Sim(3), or
    where they are only a part of all and it leaves more than ``MAX_RESIDUAL`` of their correction.
    """
    fit = _fit_similarity(x[revisited], target[revisited])
    if not bool(revisited.any()) or fit is None:
        return own
    S = torch.where(revisited[:, None, None], fit, torch.eye(4).to(x))
    left = _rms((target - apply_each(S, x))[revisited])
    if not bool(revisited.all()) and left > MAX_RESIDUAL * _rms((target - x)[revisited]):
        return own
    return S


def _revisited(
    x: Float[Tensor, "n 3"],
    target: Float[Tensor, "n 3"],
    slot: Int[Tensor, "n"],
    correction: PoseCorrection,
) -> Bool[Tensor, "n"]:
    """Disks whose anchors lie where the correction begins, or later: those that were adjusted.

    All disks if all keyframes were adjusted.
    ``slot`` is the index of an anchor among the corrected keyframes. The correction begins with the
    first that has moved; if that is the second, with the very first, which only fixes the frame.
    """
    if correction.of_all:
        return torch.ones_like(slot, dtype=torch.bool)
    poses = torch.stack([correction.before[i] for i in sorted(correction.after)]).double()
    centres = se3_inverse(poses)[:, :3, 3].to(x.device)
    way, distance = x.new_zeros(2, len(centres))
    way.index_add_(0, slot, (target - x).norm(dim=1))
    distance.index_add_(0, slot, (x - centres[slot]).norm(dim=1))
    moved = (way > MIN_MOTION * distance).nonzero()[:, 0]
    if len(moved) == 0:
        return torch.zeros_like(slot, dtype=torch.bool)
    begin = int(moved[0])
    return slot >= (0 if begin == 1 else begin)


def _nearest_in_time(ids: Int[Tensor, "k"], anchor: Int[Tensor, "n"]) -> Int[Tensor, "n"]:
    """Index of the keyframe (ids ascending) nearest to each anchor."""
    slot = torch.searchsorted(ids, anchor.to(ids.dtype)).clamp(max=len(ids) - 1)
    previous = (slot - 1).clamp(min=0)
    closer = (anchor - ids[previous]).abs() < (ids[slot] - anchor).abs()
    return torch.where(closer, previous, slot)


def _fit_similarity(
    source: Float[Tensor, "n 3"], target: Float[Tensor, "n 3"]
) -> Float[Tensor, "4 4"] | None:
    """Umeyama as a 4x4 matrix; None where the points do not determine one."""
    try:
        scale, R, t = umeyama(source, target)
    except GeogsError:
        return None
    S = torch.eye(4, dtype=source.dtype, device=source.device)
    S[:3, :3] = scale * R
    S[:3, 3] = t
    return S


def _rms(difference: Tensor) -> float:
    return float(difference.square().sum(-1).mean().sqrt())


def blended_similarities(
    x: Float[Tensor, "n 3"],
    own: Float[Tensor, "n 4 4"],
    reference: Float[Tensor, "4 4"],
    similarities: Float[Tensor, "k 4 4"],
    covisible: Iterable[tuple[CovisibleKeyframe, int]],
) -> Float[Tensor, "n 4 4"]:
    """World similarities of disks at ``x``, float64.

    ``own`` is the correction of the keyframe that made each disk. Every covisible keyframe comes
    with the index of its correction in ``similarities``. Blends are means in the Lie algebra of
    Sim(3) of the corrections relative to ``reference``, which should be near all of them; they do
    not depend on the origin of the world.
    """
    back = sim3_inverse(reference)
    total = _OWN * sim3_log(own @ back)
    weight = torch.full_like(x[:, 0], _OWN)
    corrections = to_device(sim3_log(similarities.cpu() @ back.cpu()), x.device)
    for keyframe, k in covisible:
        confidence = agreement(x, keyframe)
        total += confidence[:, None] * corrections[k]
        weight += confidence
    moved = x @ reference[:3, :3].T + reference[:3, 3]
    return sim3_exp(smoothed(x, moved, total / weight[:, None])) @ reference


def agreement(x: Float[Tensor, "n 3"], keyframe: CovisibleKeyframe) -> Float[Tensor, "n"]:
    """The keyframe's confidence, in [0, 1], that there is a surface at each point."""
    camera = keyframe.camera
    T = keyframe.T_cw.to(x)
    y = x @ T[:3, :3].T + T[:3, 3]
    z = y[:, 2].clamp(min=1e-9)
    u, v = camera.fx * y[:, 0] / z + camera.cx, camera.fy * y[:, 1] / z + camera.cy
    inwards = torch.stack([u, camera.width - 1 - u, v, camera.height - 1 - v]).amin(0)
    seen = (y[:, 2] > 0) & (inwards > 0)
    column = torch.where(seen, u, 0.0).round().long()
    row = torch.where(seen, v, 0.0).round().long()
    deviation = (z / keyframe.depth[row, column].to(x) - 1) / _AGREEMENT
    confidence = (inwards / _BORDER).clamp(max=1.0) * keyframe.confidence[row, column].to(x)
    return torch.where(seen, confidence * torch.exp(-0.5 * deviation.square()), 0.0)


def smoothed(
    x: Float[Tensor, "n 3"], moved: Float[Tensor, "n 3"], tangent: Float[Tensor, "n 7"]
) -> Float[Tensor, "n 7"]:
    """Smooth tangents at points ``x``: each is a mean over near points that move alike.

    A bilateral filter: its weights fall with the distance, and with the distance between where both
    tangents take the point ``moved`` (to first order), so layers that have to part do.
    """
    distance, index = nearest_neighbors(x, x, _NEIGHBOURS)
    width = _SPREAD * distance[:, distance.shape[1] // 2].clamp(min=1e-12)
    near = torch.exp(-0.5 * (distance / width[:, None]).square())
    for _ in range(_ROUNDS):
        total = torch.zeros_like(tangent)
        weight = torch.zeros_like(width)
        for k in range(index.shape[1]):
            other = tangent[index[:, k]]
            way = _displacement(other - tangent, moved).norm(dim=1) / (_PARTING * width)
            w = near[:, k] * torch.exp(-0.5 * way.square())
            total += w[:, None] * other
            weight += w
        tangent = total / weight[:, None]
    return tangent


def _displacement(xi: Float[Tensor, "n 7"], x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Displacement of points by small tangents, to first order."""
    return xi[:, :3] + torch.linalg.cross(xi[:, 3:6], x) + xi[:, 6:] * x
