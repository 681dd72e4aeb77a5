"""Moving the map after the trajectory was corrected: blended, coherent (the paper's), per keyframe.

Each disk has an anchor, the keyframe it was made from. The correction of its anchor would carry it
to a target position (Eq. target_position). Moving every disk to its own target tears surfaces that
several keyframes share. The coherent update fits one Sim(3) to all targets (Eq. global_sim3): it
tears nothing and cannot follow a drift. The blended one moves every disk with all keyframes that
see it where it lies (:mod:`geogs.mapping.similarity_field`).
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.errors import GeogsError
from geogs.geometry.lie import se3_inverse
from geogs.geometry.umeyama import umeyama
from geogs.mapping.similarity_field import Witness, blended_similarities
from geogs.mapping.view import MapView
from geogs.types import PoseCorrection

Strategy = Literal["blended", "coherent", "per_keyframe"]


@dataclass(frozen=True)
class MapUpdate:
    """How each disk moves, and how well one Sim(3) described it."""

    transform: Float[Tensor, "n 4 4"]
    """World similarity of each disk, float64."""
    correction: float
    """Root mean square distance between positions and targets, map units."""
    residual: float
    """Root mean square distance between targets and where the update puts the disks."""


def witness(view: MapView, correction: PoseCorrection) -> Witness:
    """What a view with a depth saw, and from where, before a correction that it has taken over."""
    depth, scale = view.dense.depth, correction.scale.get(view.id, 1.0)
    T_cw = correction.before.get(view.id, view.T_cw)
    return Witness(
        view.id, view.pool.cameras.render, T_cw, depth if scale == 1.0 else depth * scale,
        view.dense.confidence,
    )  # fmt: skip


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
    strategy: Strategy = "blended",
    witnesses: Iterable[Witness] = (),
) -> MapUpdate:
    """The similarity of every disk for a pose correction, computed where the disks live.

    Disks whose anchor is not in the correction follow the corrected keyframe nearest in time.
    ``per_keyframe`` moves each with its anchor, ``coherent`` all by the one Sim(3) that fits the
    anchors' targets best, ``blended`` each with the ``witnesses`` that see it in place (with its
    anchor where none does), evened out among neighbours; witnesses that the correction does not
    know say nothing.
    """
    if len(position) == 0:
        return MapUpdate(torch.zeros(0, 4, 4, dtype=torch.float64), 0.0, 0.0)
    ids, similarities = anchor_transforms(correction)
    own = similarities[_nearest_in_time(ids, anchor.cpu())].to(position.device)
    x = position.detach().double()
    target = apply_each(own, x)
    S = own
    if strategy != "per_keyframe" and (fit := _fit_similarity(x, target)) is not None:
        S = fit.expand(len(x), 4, 4).clone()
        if strategy == "blended":
            known = {int(i): n for n, i in enumerate(ids)}
            heard = (
                (w, similarities[known[w.keyframe_id]]) for w in witnesses if w.keyframe_id in known
            )
            S = blended_similarities(x, own, fit, heard)
    return MapUpdate(S, _rms(target - x), _rms(target - apply_each(S, x)))


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
    S[:3, :3], S[:3, 3] = scale * R, t
    return S


def _rms(difference: Tensor) -> float:
    return float(difference.square().sum(-1).mean().sqrt())
