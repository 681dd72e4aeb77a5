"""The check of ``depth_fusion.py`` and the votes of ``carve.py`` on a GPU."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64
from torch import Tensor

from geogs.config import DepthConfig
from geogs.geometry.camera import Camera
from geogs.gpu.kernels import kernels_for
from geogs.mapping import depth_fusion
from geogs.mapping.cuda.images import transforms, upload

SOURCE = Path(__file__).with_name("reprojection.cu")


def check(
    depth: Float32[Tensor, "h w"],
    confidence: Float32[Tensor, "h w"],
    T_cw: Float64[np.ndarray, "4 4"],
    depths: Float32[Tensor, "n h w"],
    confidences: Float32[Tensor, "n h w"],
    poses: Sequence[Float64[np.ndarray, "4 4"]],
    camera: Camera,
    config: DepthConfig,
) -> tuple[Tensor, Tensor]:
    """Depth and confidence of a keyframe as revised by those of others (``check_depth``)."""
    (n, h, w), device = depths.shape, depth.device
    to_others = np.stack(poses) @ np.linalg.inv(T_cw)
    both = np.stack([transforms(to_others), transforms(np.linalg.inv(to_others))])
    matrices = upload(both, device)
    settings = upload(np.array(_settings(config), np.float32), device)
    lens, kernels = (camera.fx, camera.fy, camera.cx, camera.cy), kernels_for(SOURCE, device)
    seen = torch.full((n, h, w), -1, dtype=torch.int64, device=device)
    kernels["splat_depths"](
        (-(-h * w // 256), n), 256, depths, confidences, matrices[1], h, w, *lens,
        depth_fusion.SPLAT_CONFIDENCE, seen,
    )  # fmt: skip
    new_depth, new_confidence = torch.empty_like(depth), torch.empty_like(depth)
    kernels["check_depth"](
        -(-h * w // 256), 256, depth, confidence, depths, confidences, matrices[0], seen, settings,
        n, h, w, *lens, new_depth, new_confidence,
    )  # fmt: skip
    return new_depth, new_confidence


def vote(
    points: Float32[Tensor, "n 3"],
    poses: Sequence[Float64[np.ndarray, "4 4"]],
    depths: Float32[Tensor, "v h w"],
    confidences: Float32[Tensor, "v h w"],
    camera: Camera,
    config: DepthConfig,
) -> Bool[Tensor, "n"]:
    """World points that do not stand in the free space of the views (``carve.vote``)."""
    keep = torch.empty(len(points), dtype=torch.bool, device=points.device)
    matrices = upload(transforms(np.stack(poses)), points.device)
    kernels_for(SOURCE, points.device)["vote_on_points"](
        -(-len(points) // 128), 128, points, depths, confidences, matrices, len(points),
        *depths.shape, camera.fx, camera.fy, camera.cx, camera.cy, config.vote_confidence,
        config.vote_support, config.vote_violation, config.vote_free_views, keep,
    )  # fmt: skip
    return keep


def _settings(config: DepthConfig) -> tuple[float, ...]:
    """In the order in which the kernel reads them."""
    return (
        config.average_reach, config.agreement_reach, config.violation_distance,
        config.repair_below, config.repair_votes, config.repair_confidence,
        depth_fusion.OCCLUSION_PENALTY, *depth_fusion.WEIGHTS,
    )  # fmt: skip
