"""Dense depth by matching a keyframe with its neighbours over planes of equal inverse depth."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32

from geogs.depth import plane_sweep_kernels as kernels
from geogs.depth.depth_view import DepthView, homographies, relative_poses
from geogs.depth.sampling_kernels import pixel_pairs
from geogs.geometry.camera import Camera
from geogs.threads import over_rows, run_chunks, worker_count

PLANE_STEP = 1.2
"""Pixels that the median neighbour moves from plane to plane: few enough that no match is skipped;
a parabola and the refinement then find it between planes."""
LEAST_PART = 1 / 3
"""Least number of planes as a fraction of the most, however little the neighbours move."""
WINDOW = 3
"""Side of the matching window in pixels: small, as like colours are averaged after it."""
VARIANCE_FLOOR = 1e-5
"""Grey variance (grey in 0 to 1) below which a window counts as textureless: noise."""
SUPPORT_RADIUS = 3
"""Radius in pixels over which matching costs are averaged."""
SUPPORT_SHARPNESS = 400.0
"""Rate c of their weight 1 / (1 + c |dI|^2)^2 by the colour difference (RGB in 0 to 1)."""
PRIOR_PULL = 0.3
"""Cost of a plane far from the tracker's depth where the tracker is confident."""
PRIOR_TOLERANCE = 0.03
"""Relative distance from the tracker's inverse depth at which the pull is full."""
SMALL_JUMP = 0.1
"""Semi-global matching: cost of a step by one plane, small, as slanted surfaces take many."""
LARGE_JUMP = 1.5
"""Semi-global matching: cost of a larger step where the image is flat."""
JUMP_CONTRAST = 30.0
"""Semi-global matching: rate c of the larger step's cost ``LARGE_JUMP`` / (1 + c |dI|)."""


@dataclass(frozen=True, slots=True)
class SweepResult:
    """The winners of a plane sweep at the render size."""

    inverse_depth: Float32[np.ndarray, "h w"]
    cost: Float32[np.ndarray, "h w"]
    """Matching cost 1 - NCC of the winner, 0 (alike) to 1.2."""
    margin: Float32[np.ndarray, "h w"]
    """Aggregated cost of the best other plane minus the winner's: uniqueness of the match."""
    planes: Float32[np.ndarray, "p"]
    """Inverse depths that were tried, equally spaced."""
    costs: Float32[np.ndarray, "h w p"]
    """Matching cost of each, averaged over pixels of like colour and pulled to the prior."""


def sweep_planes(
    reference: DepthView,
    neighbours: Sequence[DepthView],
    camera: Camera,
    near: float,
    far: float,
    most: int,
) -> Float32[np.ndarray, "p"]:
    """At most ``most`` inverse depths, and at least ``LEAST_PART`` of these, equally spaced.

    The median neighbour moves ``PLANE_STEP`` from one to the next; there must be a neighbour.
    """
    pixels = np.array([[x, y] for x in (0.1, 0.5, 0.9) for y in (0.1, 0.5, 0.9)])
    pixels = pixels * [camera.width, camera.height] - [camera.cx, camera.cy]
    rays = np.concatenate([pixels / [camera.fx, camera.fy], np.ones((len(pixels), 1))], 1)
    relative = relative_poses(reference, neighbours)
    rotated = rays @ np.swapaxes(relative[:, :3, :3], 1, 2)
    ends = [rotated + relative[:, None, :3, 3] / z for z in (near, far)]
    seen = np.minimum(ends[0], ends[1])[..., 2] > 0.1
    p, q = (e[..., :2] / np.where(seen, e[..., 2], 1.0)[..., None] for e in ends)
    moved = np.linalg.norm((p - q) * [camera.fx, camera.fy], axis=2)
    shifts = [np.median(m[s]) for m, s in zip(moved, seen, strict=True) if s.any()]
    steps = np.median(shifts or [0.0]) / PLANE_STEP
    count = int(np.clip(np.ceil(steps), max(2, int(LEAST_PART * most)), most))
    return np.linspace(1.0 / far, 1.0 / near, count, dtype=np.float32)


def plane_sweep(
    reference: DepthView,
    neighbours: Sequence[DepthView],
    camera: Camera,
    planes: Float32[np.ndarray, "p"],
    prior: Float32[np.ndarray, "h w"],
    prior_weight: Float32[np.ndarray, "h w"],
) -> SweepResult:
    """Plane sweep with semi-global matching (Hirschmueller 2008) in eight directions.

    The cost of a plane is the mean 1 - NCC of the better half of the neighbours (occlusion), in
    small windows that are then averaged over pixels of like colour (adaptive support weights, Yoon
    and Kweon 2006), plus a bounded pull to the ``prior`` inverse depth where ``prior_weight`` (0 to
    1) is high.
    """
    raw = matching_costs(reference, neighbours, camera, planes)
    size = (camera.width, camera.height)
    colours = cv2.resize(reference.image, size, interpolation=cv2.INTER_AREA)
    colours = colours.astype(np.float32) * np.float32(1 / 255)
    volume = np.empty_like(raw)
    sharpness = np.float32(SUPPORT_SHARPNESS)
    weight = np.float32(PRIOR_PULL) * prior_weight
    tolerance = np.float32(PRIOR_TOLERANCE)
    radius = SUPPORT_RADIUS

    def support(first: int, last: int) -> None:
        kernels.average_support(first, last, raw, colours, radius, sharpness, volume)
        kernels.pull_to_prior(first, last, volume, planes, prior, weight, tolerance)

    over_rows(support, len(volume))
    guide = cv2.GaussianBlur(reference.grey, (0, 0), 0.7)
    small, large = np.float32(SMALL_JUMP), np.float32(LARGE_JUMP)
    contrast = np.float32(JUMP_CONTRAST)
    raw.fill(0.0)  # used again, as volumes take most of the memory
    totals = raw, np.zeros_like(raw)
    run_chunks(
        lambda k: kernels.aggregate_paths(volume, guide, small, large, contrast, k == 0, totals[k]),
        len(totals),
        worker_count(),
    )
    total = np.add(*totals, out=totals[0])
    position, cost, margin = (np.empty_like(guide) for _ in range(3))
    over_rows(
        lambda *rows: kernels.pick_planes(*rows, total, volume, position, cost, margin), len(guide)
    )
    spacing = (planes[-1] - planes[0]) / np.float32(len(planes) - 1)
    return SweepResult(planes[0] + position * spacing, cost, margin, planes, volume)


def matching_costs(
    reference: DepthView,
    neighbours: Sequence[DepthView],
    camera: Camera,
    planes: Float32[np.ndarray, "p"],
    window: int = WINDOW,
) -> Float32[np.ndarray, "h w p"]:
    """Mean 1 - NCC of the better half (at least two) of the neighbours that see a point."""
    radius, floor = window // 2, np.float32(VARIANCE_FLOOR)
    grey = reference.grey - np.float32(0.5)
    images = np.stack([v.grey for v in neighbours]) - np.float32(0.5)
    size = (window, window)
    mean = cv2.blur(grey, size, borderType=cv2.BORDER_REPLICATE)
    square = cv2.blur(grey * grey, size, borderType=cv2.BORDER_REPLICATE)
    scale = 1.0 / np.sqrt(np.maximum(square - mean * mean, 0.0) + floor)
    a, b = homographies(reference, neighbours, camera, camera)
    pairs, wide = pixel_pairs(images), np.pad(grey, ((0, 0), (radius, radius)), mode="edge")
    volume = np.empty((*grey.shape, len(planes)), np.float32)
    over_rows(
        lambda *rows: kernels.match_planes(
            *rows, wide, mean, scale, pairs, a, b, planes, radius, floor, volume
        ),
        len(grey),
    )
    return volume
