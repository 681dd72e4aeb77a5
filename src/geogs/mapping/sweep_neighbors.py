"""Which keyframes to match a keyframe with, and over which depths."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from geogs.config import DepthConfig
from geogs.geometry.camera import Camera
from geogs.mapping.depth_view import DepthView
from geogs.tracking.grid import OFFSET, STRIDE


def parallax_degrees(reference: DepthView, other: DepthView, depth: float) -> tuple[float, float]:
    """Angle between the two rays to the point ``depth`` ahead, and between the two directions."""
    ray = depth * reference.forward
    back = reference.center + ray - other.center
    return _angle(ray, back), _angle(reference.forward, other.forward)


def _angle(a: Float64[np.ndarray, "3"], b: Float64[np.ndarray, "3"]) -> float:
    cosine = a @ b / (np.linalg.norm(a) * np.linalg.norm(b) + 1e-12)
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def misfit(parallax: float, turn: float, best: float) -> float:
    """How far a pair is from ``best`` degrees of parallax (log scale) and from looking alike."""
    return abs(float(np.log(max(parallax, 0.05) / best))) + (turn / 20.0) ** 2


def select_sweep_neighbours(
    reference: DepthView, candidates: Sequence[DepthView], depth: float, config: DepthConfig
) -> list[int]:
    """Indices of the at most ``config.neighbours`` best candidates, best first.

    Good is a parallax near ``config.parallax`` degrees at ``depth`` (on a log scale) and a similar
    viewing direction. Where there is choice, baselines point different ways, so that edges of any
    orientation can be matched. Too small or too large a parallax, or looking more than 35 degrees
    aside, excludes; if nobody is left, the two nearest to good are taken.
    """
    scored = []
    for i, other in enumerate(candidates):
        if other.id == reference.id:
            continue
        parallax, turn = parallax_degrees(reference, other, depth)
        usable = config.min_parallax < parallax < config.max_parallax and turn < config.max_turn
        scored.append((not usable, misfit(parallax, turn, config.parallax), i))
    scored.sort()
    usable_ids = [i for bad, _, i in scored if not bad]
    if not usable_ids:
        return [i for _, _, i in scored[:2]]
    pool = usable_ids[: 3 * config.neighbours]
    chosen: list[int] = []
    directions: list[np.ndarray] = []
    spread = len(pool) >= 2 * config.neighbours
    for i in pool:
        baseline = candidates[i].center - reference.center
        baseline = baseline / np.linalg.norm(baseline)
        if spread and any(baseline @ d > config.max_baseline_cosine for d in directions):
            continue
        chosen.append(i)
        directions.append(baseline)
    chosen += [i for i in pool if i not in chosen]
    return chosen[: config.neighbours]


def depth_range(
    reference: DepthView, others: Sequence[DepthView], working: Camera, config: DepthConfig
) -> tuple[float, float]:
    """Nearest and farthest depth to search in the reference view.

    From the surest half of what the tracker knows in this and the other views (and all whose
    relative deviation is below ``config.range_deviation``), seen from the reference and widened by
    ``config.range_margin`` on both sides. (0.1, 10) if the tracker knows next to nothing.
    """
    inverse = np.concatenate(
        [_seen_inverse_depth(reference, v, working, config) for v in (reference, *others)]
    )
    if len(inverse) < 8:
        return 0.1, 10.0
    low, high = np.percentile(inverse, [0.5, 99.5])
    return float(1.0 / high / config.range_margin), float(1.0 / low * config.range_margin)


def _seen_inverse_depth(
    reference: DepthView, view: DepthView, working: Camera, config: DepthConfig
) -> Float64[np.ndarray, "n"]:
    """Inverse depths, in the reference view, of the sure cells of ``view`` that it can see."""
    grid = view.inverse_depth.astype(np.float64)
    known = np.isfinite(grid) & (grid > 0) & (view.information > 0)
    rows, columns = np.nonzero(known)
    z = 1.0 / grid[known]
    deviation = z / np.sqrt(view.information[known])
    if len(deviation) == 0:
        return deviation
    sure = deviation <= max(config.range_deviation, float(np.median(deviation)))
    x = (OFFSET + STRIDE * columns - working.cx) / working.fx * z
    y = (OFFSET + STRIDE * rows - working.cy) / working.fy * z
    relative = reference.T_cw @ np.linalg.inv(view.T_cw)
    point = relative[:3, :3] @ np.stack([x, y, z])[:, sure] + relative[:3, 3:]
    point = point[:, point[2] > 1e-6]
    u = point[0] / point[2] * working.fx + working.cx
    v = point[1] / point[2] * working.fy + working.cy
    seen = (np.abs(2 * u / working.width - 1) < 1) & (np.abs(2 * v / working.height - 1) < 1)
    return 1.0 / point[2, seen]
