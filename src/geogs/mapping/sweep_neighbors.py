"""Which keyframes to match a keyframe with, and over which depths."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from geogs.config import DepthConfig
from geogs.geometry.camera import Camera
from geogs.mapping.completion import GRID_OFFSET, GRID_STRIDE
from geogs.mapping.depth_view import DepthView


def parallax_degrees(
    reference: DepthView, other: DepthView, depth: float
) -> tuple[float, float]:
    """Angle between the two rays to the point ``depth`` ahead, and between the two directions."""
    ray = depth * reference.forward
    back = reference.center + ray - other.center
    return _angle(ray, back), _angle(reference.forward, other.forward)


def _angle(a: Float64[np.ndarray, "3"], b: Float64[np.ndarray, "3"]) -> float:
    cosine = a @ b / (np.linalg.norm(a) * np.linalg.norm(b) + 1e-12)
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


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
        misfit = abs(np.log(max(parallax, 0.05) / config.parallax)) + (turn / 20.0) ** 2
        usable = config.min_parallax < parallax < config.max_parallax and turn < config.max_turn
        scored.append((not usable, misfit, i))
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

    From what the tracker is fairly sure of in this and the other views, seen from the reference,
    widened by ``config.range_margin`` on both sides.
    """
    inverse = [np.empty(0)]
    for view in [reference, *others]:
        grid = view.inverse_depth
        with np.errstate(divide="ignore", invalid="ignore"):
            deviation = 1.0 / (grid * np.sqrt(view.information))
        rows, columns = np.nonzero(
            np.isfinite(deviation) & (deviation < config.range_deviation) & (grid > 0)
        )
        z = 1.0 / grid[rows, columns].astype(np.float64)
        x = (GRID_OFFSET + GRID_STRIDE * columns - working.cx) / working.fx * z
        y = (GRID_OFFSET + GRID_STRIDE * rows - working.cy) / working.fy * z
        relative = reference.T_cw @ np.linalg.inv(view.T_cw)
        point = relative[:3, :3] @ np.stack([x, y, z]) + relative[:3, 3:]
        u = point[0] / np.maximum(point[2], 1e-6) * working.fx + working.cx
        v = point[1] / np.maximum(point[2], 1e-6) * working.fy + working.cy
        seen = (point[2] > 1e-6) & (abs(2 * u / working.width - 1) < 1)
        seen &= abs(2 * v / working.height - 1) < 1
        inverse.append(1.0 / point[2][seen])
    sure = np.concatenate(inverse)
    if len(sure) < 8:
        return 0.1, 10.0
    low, high = np.percentile(sure, [0.5, 99.5])
    return float(1.0 / high / config.range_margin), float(1.0 / low * config.range_margin)
