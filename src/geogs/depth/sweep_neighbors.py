"""Selection of the keyframes that a keyframe is matched with, and of its depth range."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from geogs.depth.depth_view import DepthView, ViewPose
from geogs.geometry.camera import Camera
from geogs.world.grid import OFFSET, STRIDE

NEIGHBOURS = 8
"""Keyframes to match one with: further ones are too far aside."""
BEST_PARALLAX_DEG = 6.0
"""Best angle between the rays of two keyframes: smaller ones make depth less precise, larger ones
change the appearance of surfaces."""
MIN_PARALLAX_DEG, MAX_PARALLAX_DEG = 1.0, 25.0
"""Least and largest usable angle."""
MAX_VIEW_ANGLE_DEG = 35.0
"""Largest angle between viewing directions."""
MIN_OVERLAP = 0.3
"""Least fraction of a keyframe's points that another has to see."""
USUAL_ZOOM = 1.5
"""Ratio of the distances from two keyframes at which the appearance of a surface changes."""
MAX_BASELINE_COSINE = 0.97
"""Largest cosine between two baselines where there is a choice."""
_RASTER = 9
"""Points along either side of an image from which pairs are rated."""
RANGE_MARGIN = 1.3
"""Factor by which the range exceeds that of the known depths, as not all are known."""
RANGE_DEVIATION = 0.1
"""Relative deviation below which the tracker's depths always count for the range."""


@dataclass(frozen=True, eq=False)
class ViewPairs:
    """Geometry of pairs of one keyframe and others, from a raster of points at its typical depth.

    The points cover the image: a camera that moves straight on sees no parallax ahead.
    """

    parallax: Float64[np.ndarray, "n"]
    """Degrees between the two rays to a point, median of those that both see; 0 if none."""
    rotation: Float64[np.ndarray, "n"]
    """Degrees between the viewing directions."""
    overlap: Float64[np.ndarray, "n"]
    """Fraction of the points that the other sees."""
    zoom: Float64[np.ndarray, "n"]
    """Ratio, at least 1, of the distances to a point, median of those that both see."""

    def usable(
        self, least: float, most: float, max_rotation: float = MAX_VIEW_ANGLE_DEG
    ) -> Bool[np.ndarray, "n"]:
        """Pairs of enough overlap, and of a parallax and a rotation (degrees) within bounds."""
        in_range = (self.parallax > least) & (self.parallax < most)
        return in_range & (self.rotation < max_rotation) & (self.overlap >= MIN_OVERLAP)

    def misfit(self, best: float) -> Float64[np.ndarray, "n"]:
        """Penalty for parallax other than ``best`` (log scale), rotation, zoom, missing overlap."""
        parallax = np.abs(np.log(np.maximum(self.parallax, 0.05) / best))
        zoom = (np.log(self.zoom) / np.log(USUAL_ZOOM)) ** 2
        unseen = -np.log(np.maximum(self.overlap, 0.5 / _RASTER**2))
        return np.asarray(parallax + (self.rotation / 20.0) ** 2 + zoom + unseen)


def view_pairs(
    reference: ViewPose, others: Sequence[ViewPose], depth: float, camera: Camera
) -> ViewPairs:
    """The pairs of a keyframe with others, all of one ``camera``, for surfaces at a depth."""
    steps = (np.arange(_RASTER) + 0.5) / _RASTER
    u, v = np.meshgrid(steps * camera.width - 0.5, steps * camera.height - 0.5)
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    points = depth * np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    poses = np.stack([other.T_cw for other in others])
    relative = poses @ np.linalg.inv(reference.T_cw)
    rotation = relative[:, :3, :3]
    translation = relative[:, :3, 3]
    there = points @ np.swapaxes(rotation, 1, 2) + translation[:, None]
    z = np.maximum(there[..., 2], 1e-9)
    column = camera.fx * there[..., 0] / z + camera.cx
    row = camera.fy * there[..., 1] / z + camera.cy
    seen = (there[..., 2] > 0) & (np.abs(2 * column / (camera.width - 1) - 1) <= 1)
    seen &= np.abs(2 * row / (camera.height - 1) - 1) <= 1
    own = np.linalg.norm(points, axis=-1)
    theirs = np.linalg.norm(there, axis=-1)
    cosine = (points @ np.swapaxes(rotation, 1, 2) * there).sum(-1) / (own * theirs + 1e-12)
    parallax = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    zoom = np.abs(np.log(np.maximum(theirs, 1e-12) / own))
    turned = _angles(reference.forward, poses[:, 2, :3])
    return ViewPairs(_median(parallax, seen), turned, seen.mean(1), np.exp(_median(zoom, seen)))


def _median(
    values: Float64[np.ndarray, "n m"], known: Bool[np.ndarray, "n m"]
) -> Float64[np.ndarray, "n"]:
    """The upper median of the known values of each row; 0 where there is none."""
    ordered = np.sort(np.where(known, values, np.inf), axis=1)
    count = known.sum(1)
    return np.where(count > 0, ordered[np.arange(len(ordered)), count // 2], 0.0)


def _angles(a: Float64[np.ndarray, "3"], b: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n"]:
    cosine = b @ a / (np.linalg.norm(a) * np.linalg.norm(b, axis=1) + 1e-12)
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def select_sweep_neighbours(
    reference: ViewPose,
    candidates: Sequence[ViewPose],
    depth: float,
    camera: Camera,
    most: int = NEIGHBOURS,
) -> list[int]:
    """Indices of the at most ``most`` best candidates, best first; all views are of ``camera``.

    The best have a parallax near ``BEST_PARALLAX_DEG`` at ``depth``, a similar viewing direction
    and distance, and see much of the same. Where there is a choice, baselines differ in direction,
    so that edges of any orientation can be matched. Pairs that are not ``usable`` are excluded; if
    all are, the two best of them are taken.
    """
    others = np.array([i for i, v in enumerate(candidates) if v.id != reference.id], int)
    if len(others) == 0:
        return []
    pairs = view_pairs(reference, [candidates[i] for i in others], depth, camera)
    usable = pairs.usable(MIN_PARALLAX_DEG, MAX_PARALLAX_DEG)
    order = np.lexsort((pairs.misfit(BEST_PARALLAX_DEG), ~usable))
    ranked: list[int] = others[order].tolist()
    count = int(usable.sum())
    if count == 0:
        return ranked[:2]
    pool = ranked[: min(count, 3 * most)]
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

    The range of the tracker's depths in all views, seen from the reference, widened by
    ``RANGE_MARGIN`` on both sides; of each view the more certain half, and all below
    ``RANGE_DEVIATION``, count. (0.1, 10) if the tracker knows hardly any depth.
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
