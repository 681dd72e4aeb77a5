"""Pose-only refinement on a GPU: all active keyframes in one pass."""

from collections.abc import Mapping

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.config import MappingConfig
from geogs.geometry.lie import se3_inverse
from geogs.gpu.transfer import to_device
from geogs.mapping.keyframe_views import MapView
from geogs.mapping.training.cuda.known_views import KnownViews
from geogs.mapping.training.cuda.window_pass import WindowPass
from geogs.mapping.training.pose_refine import descend
from geogs.world.disks import GaussianMap


def refine_poses(
    disks: GaussianMap,
    active: list[MapView],
    views: Mapping[int, MapView],
    known: KnownViews,
    window: WindowPass,
    config: MappingConfig,
    unit: float,
) -> dict[int, Float[Tensor, "4 4"]]:
    """As :func:`geogs.mapping.training.pose_refine.refine_poses`, from the same loss in float32.

    ``window`` has as many views as there are active keyframes, one partner each. Each step waits
    once, for the gradients of the poses; the descent itself runs on the CPU.
    """
    partners = [views[i] for view in active for i in view.row.partners[:1]]
    both = [*active, *partners]
    slot = dict(zip((v.id for v in both), known.slots(both), strict=True))
    rows = [slot[v.id] for v in active]
    rows += [slot[v.row.partners[0]] if v.row.partners else -1 for v in active]
    window.slots.copy_(to_device(torch.tensor(rows, dtype=torch.int32), disks.device))
    count = to_device(torch.tensor([len(disks)], dtype=torch.int32), disks.device)

    def evaluate(poses: Float[Tensor, "b 4 4"]) -> tuple[float, Float[Tensor, ""]]:
        known.set_poses([v.id for v in active], poses.detach())
        loss, d_poses, d_motions = _evaluate(window, disks, count)
        return loss, _chain(active, views, poses, d_poses, d_motions)

    best = descend(torch.stack([view.T_cw for view in active]), config, unit, evaluate)
    return {view.id: T for view, T in zip(active[1:], best[1:], strict=True)}


def _evaluate(
    window: WindowPass, disks: GaussianMap, count: Int[Tensor, "1"]
) -> tuple[float, Float[Tensor, "b 4 4"], Float[Tensor, "b 3 4"]]:
    """Summed loss and gradients of poses and motions, fetched in one transfer."""
    d_poses = window.d_poses
    d_motions = window.d_motions
    n = window.views
    assert d_poses is not None
    assert d_motions is not None
    status = window.rasterizer.status
    window.launch(disks.room, count)
    parts = (window.loss.double(), d_poses.reshape(-1), d_motions.reshape(-1), status.double())
    flat = torch.cat(parts).cpu()
    if flat[-1]:  # the lists had no room
        status.zero_()
        window.rasterizer.reserve(int(flat[-2]))
        return _evaluate(window, disks, count)
    motions = flat[17 * n : 29 * n].view(n, 3, 4)
    return float(flat[:n].sum()), flat[n : 17 * n].view(n, 4, 4), motions


def _chain(
    active: list[MapView],
    views: Mapping[int, MapView],
    poses: Float[Tensor, "b 4 4"],
    d_poses: Float[Tensor, "b 4 4"],
    d_motions: Float[Tensor, "b 3 4"],
) -> Float[Tensor, ""]:
    """A scalar with the loss's gradient with respect to the poses."""
    pose_of = {view.id: T for view, T in zip(active, poses, strict=True)}
    total = (poses * d_poses).sum()
    for k, view in enumerate(active):
        for i in view.row.partners[:1]:
            target = pose_of.get(i, views[i].T_cw)
            total = total + ((target @ se3_inverse(poses[k]))[:3] * d_motions[k]).sum()
    return total
