"""Which keyframes to match a keyframe with, and over which depths."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from geogs.depth.depth_view import DepthView, ViewPose
from geogs.geometry.camera import Camera
from geogs.world.grid import OFFSET, STRIDE

NEIGHBOURS = 8
"""Keyframes to match one with: more see it from farther aside."""
BEST_PARALLAX_DEG = 6.0
"""Best angle between the rays of two keyframes: smaller ones tell less, larger ones look less
alike."""
MIN_PARALLAX_DEG, MAX_PARALLAX_DEG = 1.0, 25.0
"""Least and largest usable angle."""
MAX_VIEW_ANGLE_DEG = 35.0
"""Largest angle between viewing directions."""
MAX_BASELINE_COSINE = 0.97
"""Baselines closer to parallel than this are left to others where there is choice."""
RANGE_MARGIN = 1.3
"""Factor by which searched depths go beyond those that are known, which are not all."""
RANGE_DEVIATION = 0.1
"""Relative deviation below which the tracker's depth counts for the range."""


def parallax_degrees(
    reference: ViewPose, others: Sequence[ViewPose], depth: float
) -> tuple[Float64[np.ndarray, "n"], Float64[np.ndarray, "n"]]:
    """Angles between the two rays to the point ``depth`` ahead, and between the two directions."""
    poses = np.stack([v.T_cw for v in others])
    centers = -(np.swapaxes(poses[:, :3, :3], 1, 2) @ poses[:, :3, 3:])[:, :, 0]
    ray = depth * reference.forward
    return (
        _angles(ray, reference.center + ray - centers),
        _angles(reference.forward, poses[:, 2, :3]),
    )


def _angles(a: Float64[np.ndarray, "3"], b: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n"]:
    cosine = b @ a / (np.linalg.norm(a) * np.linalg.norm(b, axis=1) + 1e-12)
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def misfit(
    parallax: Float64[np.ndarray, "n"], rotation: Float64[np.ndarray, "n"], best: float
) -> Float64[np.ndarray, "n"]:
    """How far pairs are from ``best`` degrees of parallax (log scale) and from looking alike."""
    return np.abs(np.log(np.maximum(parallax, 0.05) / best)) + (rotation / 20.0) ** 2


def select_sweep_neighbours(
    reference: ViewPose, candidates: Sequence[ViewPose], depth: float, most: int = NEIGHBOURS
) -> list[int]:
    """Indices of the at most ``most`` best candidates, best first.

    Good is a parallax near ``BEST_PARALLAX_DEG`` at ``depth`` (on a log scale) and a similar
    viewing direction. Where there is choice, baselines point different ways, so that edges of any
    orientation can be matched. Too small or too large a parallax, or looking more than 35 degrees
    aside, excludes; if nobody is left, the two nearest to good are taken.
    """
    others = np.array([i for i, v in enumerate(candidates) if v.id != reference.id], int)
    if len(others) == 0:
        return []
    parallax, rotation = parallax_degrees(reference, [candidates[i] for i in others], depth)
    usable = (parallax > MIN_PARALLAX_DEG) & (parallax < MAX_PARALLAX_DEG)
    usable &= rotation < MAX_VIEW_ANGLE_DEG
    order = np.lexsort((misfit(parallax, rotation, BEST_PARALLAX_DEG), ~usable))
    ranked: list[int] = others[order].tolist()
    count = int(usable.sum())
    if count == 0:
        return ranked[:2]
    usable_ids = ranked[:count]
    pool = usable_ids[: 3 * most]
    chosen: list[int] = []
    directions: list[np.ndarray] = []
    spread = len(pool) >= 2 * most
    for i in pool:
        baseline = candidates[i].center - reference.center
        baseline = baseline / np.linalg.norm(baseline)
        if spread and any(baseline @ d > MAX_BASELINE_COSINE for d in directions):
            continue
        chosen.append(i)
        directions.append(baseline)
    chosen += [i for i in pool if i not in chosen]
    return chosen[:most]


def depth_range(
    reference: DepthView, others: Sequence[DepthView], working: Camera
) -> tuple[float, float]:
    """Nearest and farthest depth to search in the reference view.

    From the more certain half of what the tracker knows in this and the other views (and all whose
    relative deviation is below ``RANGE_DEVIATION``), seen from the reference and widened by
    ``RANGE_MARGIN`` on both sides. (0.1, 10) if the tracker knows next to nothing.
    """
    inverse = seen_inverse_depth(reference, (reference, *others), working)
    if len(inverse) < 8:
        return 0.1, 10.0
    low, high = np.percentile(inverse, [0.5, 99.5])
    return float(1.0 / high / RANGE_MARGIN), float(1.0 / low * RANGE_MARGIN)


def seen_inverse_depth(
    reference: DepthView, views: Sequence[DepthView], working: Camera
) -> Float64[np.ndarray, "n"]:
    """Inverse depths, in the reference view, of the views' confident cells that it can see."""
    grid = np.stack([v.inverse_depth for v in views]).astype(np.float64)
    information = np.stack([v.information for v in views])
    known = np.isfinite(grid) & (grid > 0) & (information > 0)
    z = 1.0 / np.where(known, grid, 1.0)
    deviation = z / np.sqrt(np.where(known, information, np.float32(1.0)))
    medians = [np.median(d[k]) if k.any() else 0.0 for d, k in zip(deviation, known, strict=True)]
    limits = np.maximum(RANGE_DEVIATION, medians)
    confident = known & (deviation <= limits[:, None, None])
    x = (OFFSET + STRIDE * np.arange(grid.shape[2]) - working.cx) / working.fx * z
    y = (OFFSET + STRIDE * np.arange(grid.shape[1])[:, None] - working.cy) / working.fy * z
    relative = reference.T_cw @ np.linalg.inv(np.stack([v.T_cw for v in views]))
    camera = np.stack([x, y, z], 1).reshape(len(views), 3, -1)
    point = relative[:, :3, :3] @ camera + relative[:, :3, 3:]
    point = point.transpose(1, 0, 2).reshape(3, -1).take(np.flatnonzero(confident), 1)
    point = point.take(np.flatnonzero(point[2] > 1e-6), 1)
    u = point[0] / point[2] * working.fx + working.cx
    v = point[1] / point[2] * working.fy + working.cy
    seen = (np.abs(2 * u / working.width - 1) < 1) & (np.abs(2 * v / working.height - 1) < 1)
    return 1.0 / point[2, seen]
