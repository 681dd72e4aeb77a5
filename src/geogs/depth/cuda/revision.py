"""Checks and revisions of searched depths on a GPU, by other keyframes' depths and images.

They are those of ``fusion.py``, ``carve.py`` and ``revision``.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int64
from torch import Tensor

from geogs.depth import carve, fusion
from geogs.depth.cuda.images import KeyframeImages, packed
from geogs.depth.depth_view import PosedDepth
from geogs.depth.revision.photo_vote import CONTRAST, DEVIATIONS, LEAST_DEVIATION, RADIUS
from geogs.depth.revision.revised_searches import MIN_GAP, as_depth, inverse_planes
from geogs.geometry.camera import Camera
from geogs.gpu.kernels import kernels_for
from geogs.gpu.transfer import upload

REPROJECTION = Path(__file__).with_name("reprojection.cu")
FAR_SIDE = Path(__file__).with_name("far_side.cu")
PHOTO_VOTE = Path(__file__).with_name("photo_vote.cu")
VOTERS_TOGETHER = 256
"""Views that vote in one launch."""


def check(own: PosedDepth, others: Sequence[PosedDepth], camera: Camera) -> tuple[Tensor, Tensor]:
    """Depth and confidence of a keyframe as revised by those of others (``check_depth``)."""
    depth = own.depth.depth
    confidence = own.depth.confidence
    (h, w), n, device = depth.shape, len(others), depth.device
    to_others = np.stack([o.T_cw for o in others]) @ np.linalg.inv(own.T_cw)
    both = np.concatenate([to_others, np.linalg.inv(to_others)])
    matrices = upload(packed(both[:, :3, :3], both[:, :3, 3]), device).view(2, n, 12)
    maps = upload(_addresses(others), device)
    settings = upload(np.array(CheckSettings(), np.float32), device)
    lens = (camera.fx, camera.fy, camera.cx, camera.cy)
    kernels = kernels_for(REPROJECTION, device)
    seen = torch.full((n, h, w), -1, dtype=torch.int64, device=device)
    kernels["splat_depths"](
        (-(-h * w // 256), n), 256, maps, matrices[1], h, w, *lens, fusion.SPLAT_CONFIDENCE, seen
    )
    new_depth = torch.empty_like(depth)
    new_confidence = torch.empty_like(depth)
    kernels["check_depth"](
        -(-h * w // 256), 256, depth, confidence, maps, matrices[0], seen, settings, n, h, w, *lens,
        new_depth, new_confidence,
    )  # fmt: skip
    return new_depth, new_confidence


def vote(
    points: Float32[Tensor, "n 3"], depths: Sequence[PosedDepth], camera: Camera
) -> Bool[Tensor, "n"]:
    """World points outside the free space of the views (``carve.vote``), some views at a time."""
    device = points.device
    keep = torch.empty(len(points), dtype=torch.bool, device=device)
    votes = torch.zeros(len(points), 2, dtype=torch.int32, device=device)
    for start in range(0, len(depths), VOTERS_TOGETHER):
        batch = list(depths[start : start + VOTERS_TOGETHER])  # keeps what the kernel reads
        T_cw = np.stack([d.T_cw for d in batch])
        matrices = upload(packed(T_cw[:, :3, :3], T_cw[:, :3, 3]), device)
        maps, skies = (upload(a, device) for a in (_addresses(batch), _skies(batch)))
        kernels_for(REPROJECTION, device)["vote_on_points"](
            -(-len(points) // 128), 128, points, maps, skies, matrices, len(points), len(batch),
            *batch[0].depth.depth.shape, camera.fx, camera.fy, camera.cx, camera.cy,
            carve.VOTE_CONFIDENCE, carve.VOTE_SUPPORT, carve.VOTE_VIOLATION, carve.VOTE_FREE_VIEWS,
            votes, keep,
        )  # fmt: skip
    return keep


def _addresses(depths: Sequence[PosedDepth]) -> Int64[np.ndarray, "n 2"]:
    """Addresses of each depth and confidence; kernels of this stream may read them from now on."""
    maps = [(d.depth.depth, d.depth.confidence) for d in depths]
    assert all(a.is_contiguous() and b.is_contiguous() for a, b in maps)
    return np.array([(a.data_ptr(), b.data_ptr()) for a, b in maps], np.int64)


def _skies(depths: Sequence[PosedDepth]) -> Int64[np.ndarray, "n"]:
    """Address of each sky mask; 0 where there is none."""
    skies = [d.depth.sky for d in depths]
    assert all(s is None or s.is_contiguous() for s in skies)
    return np.array([0 if s is None else s.data_ptr() for s in skies], np.int64)


class CheckSettings(NamedTuple):
    """The struct of this name in ``reprojection.cu``."""

    average_reach: float = fusion.AVERAGE_REACH
    agreement_reach: float = fusion.AGREEMENT_REACH
    violation_distance: float = fusion.VIOLATION_DISTANCE
    repair_below: float = fusion.REPAIR_BELOW
    repair_votes: float = fusion.REPAIR_VOTES
    repair_confidence: float = fusion.REPAIR_CONFIDENCE
    occlusion_penalty: float = fusion.OCCLUSION_PENALTY
    bias: float = fusion.BIAS
    own: float = fusion.OWN
    support: float = fusion.SUPPORT
    violation: float = fusion.VIOLATION


def farther_surface(depth: Float32[Tensor, "h w"], reach: int) -> Float32[Tensor, "h w"]:
    """As :func:`geogs.depth.revision.revised_searches.farther_surface`."""
    planes = inverse_planes(depth)
    height, width = depth.shape
    found = torch.zeros_like(planes)
    age = torch.zeros(height, width, dtype=torch.int32, device=depth.device)
    farthest = planes[0].amin()
    kernel = kernels_for(FAR_SIDE, depth.device)["farther_planes"]
    tiles = -(-width // 32), -(-height // 4)
    for round in range(1, reach + 1):
        kernel(tiles, (32, 4), planes, farthest, 1 - MIN_GAP, round, height, width, found, age)
    return as_depth(found[0])


def photo_costs(
    own: KeyframeImages,
    others: Sequence[KeyframeImages],
    poses: Float[np.ndarray, "n 4 4"],
    depths: Float32[Tensor, "2 h w"],
    same: Bool[Tensor, "h w"],
    camera: Camera,
    mask: Bool[Tensor, "h w"] | None = None,
) -> Float32[Tensor, "2 h w"]:
    """As :func:`geogs.depth.revision.photo_vote.photo_costs`; ``poses`` take the frame of the
    depths to those of the others, at most 16."""
    device = depths.device
    n = len(others)
    h, w = depths.shape[1:]
    if mask is not None:
        depths = torch.stack([depths[0], torch.where(mask, depths[1], depths[0])])
    kernels = kernels_for(PHOTO_VOTE, device)
    lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    numbers = np.concatenate([lens, poses[:, :3].ravel()]).astype(np.float32)
    lens, T = upload(numbers, device).split([4, 12 * n])
    differences = depths.new_empty(2, n, h, w)
    tiles = -(-w // 32), -(-h // 4)
    kernels["grey_differences"](
        (*tiles, 2 * n), (32, 4), own.grey, torch.stack([o.grey for o in others]), T, lens,
        depths.contiguous(), n, h, w, differences,
    )  # fmt: skip
    offset, limit = offset_and_limit(differences[0], same)
    costs = torch.empty_like(depths)
    means = torch.empty_like(depths)
    kernels["pixel_costs"](
        (-(-h * w // 128), 2), (128,), differences, offset, limit, n, h * w, costs
    )
    kernels["average_costs"](tiles, (32, 4), costs, own.colours, RADIUS, -1 / CONTRAST, h, w, means)
    return means if mask is None else torch.where(mask, means, 0.0)


def offset_and_limit(
    differences: Float[Tensor, "n h w"], same: Bool[Tensor, "h w"]
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Median grey difference of each neighbour where both depths are the ``same``, and the
    deviation from it at which differences are cut."""
    known = torch.where(same, differences, torch.nan).flatten(1)
    offset = known.nanmedian(1).values.nan_to_num()
    deviation = (known - offset[:, None]).abs().nanmedian(1).values.nan_to_num()
    return offset, DEVIATIONS * deviation.clamp(min=LEAST_DEVIATION)
