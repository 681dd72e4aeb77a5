"""One depth from the tracker's and the plane sweep's, and what other views say to it."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Float64

from geogs.config import DepthConfig
from geogs.geometry.camera import Camera
from geogs.mapping.carve import look_up
from geogs.mapping.completion import CompletedDepth, upsample_grid
from geogs.mapping.depth_view import KeyframeDepth
from geogs.mapping.plane_sweep import SweepResult


def tracker_confidence(
    deviation: Float32[np.ndarray, "*s"], config: DepthConfig
) -> Float32[np.ndarray, "*s"]:
    """1 / (1 + (deviation / sure_deviation)^2) of a relative standard deviation."""
    return 1.0 / (1.0 + (deviation / np.float32(config.sure_deviation)) ** 2)


def kink_weight(inverse_depth: Float32[np.ndarray, "gh gw"]) -> Float32[np.ndarray, "gh gw"]:
    """Near 1 on planes, near 0 where inverse depth bends sharply between cells.

    Interpolating across such a place makes a curtain between foreground and background.
    """
    bend = np.zeros_like(inverse_depth)
    q = inverse_depth
    bend[:, 1:-1] = np.abs(q[:, 2:] + q[:, :-2] - 2 * q[:, 1:-1])
    bend[1:-1] = np.maximum(bend[1:-1], np.abs(q[2:] + q[:-2] - 2 * q[1:-1]))
    return np.exp(-((bend / (0.06 * q)) ** 2))


def fuse(
    completed: CompletedDepth,
    sweep: SweepResult,
    working: Camera,
    render: Camera,
    config: DepthConfig,
) -> KeyframeDepth:
    """Per pixel the tracker's completed depth or the sweep's, whichever is surer."""
    d1 = upsample_grid(completed.inverse_depth, working, render)
    deviation = np.where(completed.inlier, completed.deviation, np.float32(1.0))
    precision = upsample_grid(1.0 / np.maximum(deviation, np.float32(1e-3)), working, render)
    kink = upsample_grid(kink_weight(completed.inverse_depth), working, render)
    c1 = tracker_confidence(1.0 / precision, config) * np.maximum(kink, np.float32(0.02))
    d2 = sweep.inverse_depth
    c2 = np.clip((sweep.margin - 0.5) / 2.0, 0.0, 1.0) * (sweep.cost < 0.8)
    agree = np.abs(d2 / d1 - 1.0) < 0.05
    tracker = (agree & (c1 > 0.3)) | ((c1 > 0.5) & (c2 < 0.3))
    inverse = np.where(tracker, d1, d2)
    confidence = np.where(tracker, np.where(agree, np.maximum(c1, c2), c1), 0.7 * c2)
    return KeyframeDepth((1.0 / inverse).astype(np.float32), confidence.astype(np.float32))


def check_depth(
    depth: KeyframeDepth,
    T_cw: Float64[np.ndarray, "4 4"],
    others: Sequence[KeyframeDepth],
    other_poses: Sequence[Float64[np.ndarray, "4 4"]],
    camera: Camera,
    config: DepthConfig,
) -> KeyframeDepth:
    """The depth with its confidence revised by the depths of other keyframes."""
    points = depth.depth.reshape(-1, 1) * camera.rays().numpy().reshape(-1, 3)
    support, violation = np.zeros(len(points), np.float32), np.zeros(len(points), np.float32)
    T_wc = np.linalg.inv(T_cw)
    for other, pose in zip(others, other_poses, strict=True):
        ratio, sure = look_up(points, pose @ T_wc, other, camera)
        support += sure * np.exp(-0.5 * ((ratio - 1.0) / 0.015) ** 2)
        violation += np.where((sure > 0.3) & (ratio < 0.94), sure, 0.0)
    agreement = np.clip((support - 0.2) / 1.5, 0.0, 1.0)
    agreement *= np.where(violation > 1.0 + support, 0.05, 1.0)
    agreement = agreement.reshape(depth.depth.shape)
    own = depth.confidence
    confidence = (0.3 * own + 0.7 * np.maximum(own, 0.5 * agreement)) * agreement
    return KeyframeDepth(depth.depth, confidence.astype(np.float32))
