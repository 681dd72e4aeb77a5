"""DROID-SLAM's network run on clips, every update followed by a bundle adjustment."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.tracking.flow.correlation import CorrelationVolume
from geogs.tracking.flow.droid import DAMPING_SHARE, WEIGHT_SCALE
from geogs.tracking.flow.droid_network import (
    CORRELATION_SCALE,
    LEVELS,
    RADIUS,
    DroidNetwork,
    cell_positions,
    motion_features,
    on_cells,
)
from geogs.world.grid import OFFSET, STRIDE
from geogs_train.bundle import (
    ClipBundleOptions,
    ClipCameras,
    ClipEdges,
    ClipMatches,
    ClipState,
    adjust,
    reproject,
)
from geogs_train.pose_loss import Estimate


@dataclass(frozen=True)
class UnrollOptions:
    """How often the network is run; the defaults are those DROID-SLAM was trained with."""

    updates: int = 15
    bundle: ClipBundleOptions = field(default_factory=ClipBundleOptions)


def cell_cameras(
    intrinsics: Float[Tensor, "b 4"], height: int, width: int
) -> tuple[ClipCameras, int, int]:
    """Cameras in cells of images of a size in pixels; rows and columns of cells."""
    rows, columns = height // STRIDE, width // STRIDE
    # The first cell is at pixel 4, and has position 0.
    centred = intrinsics - intrinsics.new_tensor([0, 0, OFFSET, OFFSET])
    cells = cell_positions(rows, columns, intrinsics.device).reshape(-1, 2).to(intrinsics)
    return ClipCameras(centred / STRIDE, cells), rows, columns


def unroll(
    network: DroidNetwork,
    images: Float[Tensor, "b v 3 h w"],
    intrinsics: Float[Tensor, "b 4"],
    start: ClipState,
    edges: ClipEdges,
    options: UnrollOptions | None = None,
) -> list[Estimate]:
    """Poses, depths and residuals after every update.

    Args:
        network: what is trained.
        images: RGB in [0, 1].
        intrinsics: fx, fy, cx, cy in pixels.
        start: poses and depths to begin with; those that stay fixed must be right.
        edges: which views are matched with which.
        options: number of updates, and how their output is adjusted.

    Each update learns from its own adjustment: the state it starts from has no gradient, only the
    hidden states carry one from update to update.
    """
    options = options or UnrollOptions()
    batch, views = images.shape[:2]
    cameras, rows, columns = cell_cameras(intrinsics, *images.shape[3:])
    shown = on_cells(images.flatten(0, 1))
    features = network.features(shown).unflatten(0, (batch, views))
    hidden, static = (
        x.unflatten(0, (batch, views))[:, edges.source].flatten(0, 1)
        for x in network.context(shown)
    )
    first, second = (features[:, k].flatten(0, 1) for k in (edges.source, edges.target))
    lookup = CorrelationVolume(first, second, LEVELS, RADIUS, CORRELATION_SCALE)
    of_clip = views * torch.arange(batch, device=images.device)[:, None]
    source = (of_clip + edges.source).flatten()
    shape = (batch, len(edges.source), rows * columns, 2)

    state, target, found = start, None, []
    for _ in range(options.updates):
        state = state.detach()
        position = reproject(cameras, state, edges).pixels.reshape(-1, rows, columns, 2)
        motion = motion_features(position, position if target is None else target.detach())
        out = network.update(hidden, static, lookup(position), motion)
        hidden, target = out.hidden, position + out.delta.permute(0, 2, 3, 1)
        frames = network.update.agg(hidden, source)
        damping = frames.damping.new_zeros(batch * views, rows * columns)
        damping = damping.index_copy(0, frames.frames, DAMPING_SHARE * frames.damping.flatten(1))
        matches = ClipMatches(
            target.reshape(shape),
            WEIGHT_SCALE * out.weight.permute(0, 2, 3, 1).reshape(shape),
            damping.unflatten(0, (batch, views)),
        )
        state = adjust(cameras, state, edges, matches, options.bundle)
        after = reproject(cameras, state, edges)
        found.append(Estimate(state, (matches.pixels - after.pixels) * after.valid[..., None]))
    return found
