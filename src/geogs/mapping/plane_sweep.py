"""Dense depth by matching a keyframe with its neighbours over planes of equal inverse depth."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32

from geogs.config import DepthConfig
from geogs.geometry.camera import Camera
from geogs.mapping import plane_sweep_kernels as kernels
from geogs.mapping.depth_view import DepthView


@dataclass(frozen=True, slots=True)
class SweepResult:
    """The winners of a plane sweep at the render size."""

    inverse_depth: Float32[np.ndarray, "h w"]
    cost: Float32[np.ndarray, "h w"]
    """Matching cost 1 - NCC of the winner, 0 (alike) to 1.2."""
    margin: Float32[np.ndarray, "h w"]
    """Aggregated cost of the best other plane less the winner's: how unique the match is."""


def sweep_planes(
    reference: DepthView,
    neighbours: Sequence[DepthView],
    camera: Camera,
    near: float,
    far: float,
    config: DepthConfig,
) -> Float32[np.ndarray, "p"]:
    """Inverse depths, equally spaced, so that the median neighbour moves ``plane_step`` pixels."""
    corners = np.array([[x, y] for x in (0.1, 0.5, 0.9) for y in (0.1, 0.5, 0.9)])
    pixels = corners * [camera.width, camera.height]
    rays = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    rays = np.concatenate([rays, np.ones((len(rays), 1))], 1)
    shifts = []
    for view in neighbours:
        relative = view.T_cw @ np.linalg.inv(reference.T_cw)
        ends = [rays @ relative[:3, :3].T + relative[:3, 3] / z for z in (near, far)]
        seen = (ends[0][:, 2] > 0.1) & (ends[1][:, 2] > 0.1)
        if seen.any():
            p, q = (e[seen, :2] / e[seen, 2:] * [camera.fx, camera.fy] for e in ends)
            shifts.append(np.median(np.linalg.norm(p - q, axis=1)))
    shift = float(np.median(shifts)) if shifts else 0.0
    count = int(np.clip(np.ceil(shift / config.plane_step), config.min_planes, config.max_planes))
    return np.linspace(1.0 / far, 1.0 / near, count, dtype=np.float32)


def relative_homographies(
    reference: DepthView, neighbours: Sequence[DepthView], camera: Camera
) -> tuple[np.ndarray, np.ndarray]:
    """a (n, 3, 3) and b (n, 3), float64: pixel p at inverse depth rho maps to a p + rho b."""
    k = camera.matrix().numpy()
    relative = [v.T_cw @ np.linalg.inv(reference.T_cw) for v in neighbours]
    a = np.stack([k @ m[:3, :3] @ np.linalg.inv(k) for m in relative])
    return a, np.stack([k @ m[:3, 3] for m in relative])


def _match(reference, neighbours, camera, planes, zoom, config):
    camera = camera.resized(round(camera.width / zoom), round(camera.height / zoom))
    def shrink(g): return g if zoom == 1 else cv2.resize(g, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    radius, floor = config.window // 2, np.float32(config.variance_floor)
    grey = shrink(reference.grey) - np.float32(0.5)
    images = np.stack([shrink(v.grey) for v in neighbours]) - np.float32(0.5)
    size = (config.window, config.window)
    mean = cv2.blur(grey, size, borderType=cv2.BORDER_REPLICATE)
    square = cv2.blur(grey * grey, size, borderType=cv2.BORDER_REPLICATE)
    scale = 1.0 / np.sqrt(np.maximum(square - mean * mean, 0.0) + floor)
    keep = config.keep if config.keep else max(min(2, len(neighbours)), (len(neighbours) + 1) // 2)
    keep=min(keep,len(neighbours))
    a, b = relative_homographies(reference, neighbours, camera)
    volume = np.empty((*grey.shape, len(planes)), np.float32)
    kernels.match_planes(grey, mean, scale, images, a, b, planes, radius, floor, keep, volume)
    return volume


def plane_sweep(
    reference: DepthView,
    neighbours: Sequence[DepthView],
    camera: Camera,
    planes: Float32[np.ndarray, "p"],
    prior: Float32[np.ndarray, "h w"],
    prior_weight: Float32[np.ndarray, "h w"],
    config: DepthConfig,
) -> SweepResult:
    """Plane sweep with semi-global matching (Hirschmueller 2008) in eight directions.

    The cost of a plane is the mean 1 - NCC of the better half of the neighbours (occlusion), plus
    a bounded pull to the ``prior`` inverse depth where ``prior_weight`` (0 to 1) is high.
    """
    volume = _match(reference, neighbours, camera, planes, 1, config)
    if config.support_radius > 0:
        guide = cv2.resize(reference.image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        raw, volume = volume, np.empty_like(volume)
        kernels.average_support(
            raw, guide.astype(np.float32) / np.float32(255), config.support_radius,
            np.float32(config.support_sharpness), volume,
        )
    grey = reference.grey - np.float32(0.5)
    tolerance = np.float32(config.prior_tolerance)
    kernels.pull_to_prior(
        volume, planes, prior, np.float32(config.prior_pull) * prior_weight, tolerance
    )
    guide = cv2.GaussianBlur(grey, (0, 0), 0.7)
    total = np.zeros_like(volume)
    small, large = np.float32(config.small_jump), np.float32(config.large_jump)
    edge = np.float32(config.jump_contrast)
    kernels.aggregate_paths(volume, guide, small, large, edge, True, total)
    kernels.aggregate_paths(volume, guide, small, large, edge, False, total)
    position, cost, margin = (np.empty_like(grey) for _ in range(3))
    kernels.pick_planes(total, volume, position, cost, margin)
    spacing = (planes[-1] - planes[0]) / np.float32(len(planes) - 1)
    return SweepResult(planes[0] + position * spacing, cost, margin)
