"""Views whose poses are known: what there is instead of a tracker's depth.

A tracker says how far the scene is; here that is found first. A few small images are swept over
ranges of depth around growing distances, each with neighbours that suit the distance. At the right
one many pixels match, and their points tell every view where its own depth may lie.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float64

from geogs.config import DepthConfig, SearchConfig
from geogs.depth.plane_sweep import SweepResult, plane_sweep
from geogs.depth.sweep_neighbors import parallax_degrees, select_sweep_neighbours
from geogs.depth.view import DepthSearch, DepthView
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.mapping.view import MapView
from geogs.threads import thread_map

# A sweep around a distance d goes from d / NEAR to d * FAR; the next distance is RATIO times d.
_NEAR, _FAR, _RATIO = 3.0, 6.0, 2.5
# Parallax in degrees of the nearest two cameras at the first distance, of the farthest at the last.
_WIDEST, _NARROWEST = 25.0, 1.5
_NEIGHBOURS, _PLANES = 6, 64
# A match counts if the windows are this alike and the next best plane is this much worse.
_MAX_COST, _MIN_MARGIN = 0.3, 1.0
# Share of the pixels that must match somewhere. Measured: 0.4 to 0.9 where poses are right, below
# 0.06 with camera-to-world taken for world-to-camera.
_LEAST_CLEAR = 0.05
# Planes at the ends of a range win for whatever lies beyond it.
_END = 0.04
FEWEST_POINTS = 100
"""Points of all views that tell where the scene is."""
# Points of a view's own that say enough about its depths.
_ENOUGH_POINTS = 50
# Points taken from each dense depth.
_POINTS_PER_VIEW = 2000
# Least confidence of a pixel that gives a point.
_SURE = 0.7


def distances_to_try(views: Sequence[DepthView]) -> Float64[np.ndarray, "n"]:
    """Typical depths that images from these places could show, in a geometric series.

    None where all cameras stand in the same place: then no depth shows.
    """
    centres = np.stack([v.center for v in views])
    apart = np.linalg.norm(centres[:, None] - centres, axis=2)
    extent = apart.max()
    if extent <= 1e-9 * max(1.0, float(np.abs(centres).max())):
        return np.empty(0)
    nearest = np.where(apart > 1e-6 * extent, apart, np.inf).min(1)
    first = float(np.median(nearest)) / np.tan(np.radians(_WIDEST))
    last = extent / np.tan(np.radians(_NARROWEST))
    count = 2 + int(np.log(last / first) / np.log(_RATIO))
    return first * _RATIO ** np.arange(count)


@dataclass(frozen=True)
class _Look:
    """A small view swept around a distance."""

    reference: DepthView
    neighbours: list[DepthView]
    distance: float
    mask: Bool[np.ndarray, "h w"]


def first_points(
    views: Sequence[MapView],
    working: Camera,
    config: DepthConfig,
    search: SearchConfig,
    progress: Callable[[float], None],
) -> Float64[np.ndarray, "n 3"]:
    """Points of the scene that some of the views show without doubt, in the world.

    Of the distances that can be tried, those at the one where most pixels find a clear match.

    Raises:
        InputError: hardly anything matches anywhere.
    """
    camera = working.with_long_edge(min(search.first_edge, max(working.width, working.height)))
    small = [_shrunk(v.depth_view, camera) for v in views]
    chosen = np.unique(
        np.linspace(0, len(views) - 1, min(search.first_views, len(views))).astype(int)
    )
    looks = [
        _Look(small[i], neighbours, float(d), _small_mask(views[i], camera))
        for d in distances_to_try([v.depth_view for v in views])
        for i in chosen
        if (neighbours := _matched_at(small[i], small, float(d), config))
    ]
    found = thread_map(lambda look: _clear_matches(look, camera, config), looks, progress)
    points: dict[float, list[np.ndarray]] = {}
    for look, some in zip(looks, found, strict=True):
        points.setdefault(look.distance, []).append(some)
    gathered = [np.concatenate(p) for p in points.values()]
    best = max(gathered, key=len, default=np.empty((0, 3)))
    pixels = sum(int(_small_mask(views[i], camera).sum()) for i in chosen)
    if len(best) < max(FEWEST_POINTS, _LEAST_CLEAR * pixels):
        raise InputError(
            "No two images show the same surface from two places where their poses say; are the "
            "poses, their axes and the intrinsics those of these images?"
        )
    return best


def depth_search(
    view: DepthView, points: Float64[np.ndarray, "n 3"], camera: Camera, margin: float
) -> DepthSearch:
    """Where a view's depth may lie: where the points do that it sees, widened by ``margin``.

    Of all points where it sees few.
    """
    x, y, z = (points @ view.T_cw[:3, :3].T + view.T_cw[:3, 3]).T
    ahead = z > 1e-6 * np.abs(z).max()
    safe = np.where(ahead, z, 1.0)
    u = camera.fx * x / safe + camera.cx
    v = camera.fy * y / safe + camera.cy
    seen = ahead & (u > 0) & (v > 0) & (u < camera.width - 1) & (v < camera.height - 1)
    if seen.sum() < _ENOUGH_POINTS:
        seen = ahead if ahead.any() else np.ones_like(ahead)
    depths = np.abs(z[seen])
    near, typical, far = np.percentile(depths, [0.5, 50.0, 99.5])
    return DepthSearch(float(near / margin), float(typical), float(far * margin))


def expect_depths(
    views: Iterable[MapView], points: Float64[np.ndarray, "n 3"], camera: Camera, margin: float
) -> None:
    """Let every view's depth be searched where these points say; its grid counts for nothing."""
    for view in views:
        view.search = depth_search(view.depth_view, points, camera, margin)


def dense_points(
    views: Sequence[MapView], camera: Camera, random: np.random.Generator
) -> Float64[np.ndarray, "n 3"]:
    """World points of some sure pixels of each view's depth."""
    rays = camera.rays(torch.float64).numpy()
    points = []
    for view in views:
        depth = view.dense.arrays()
        v, u = np.nonzero(depth.confidence >= _SURE)
        some = random.permutation(len(v))[:_POINTS_PER_VIEW]
        local = rays[v[some], u[some]] * depth.depth[v[some], u[some], None]
        T_cw = view.depth_view.T_cw
        points.append((local - T_cw[:3, 3]) @ T_cw[:3, :3])
    return np.concatenate(points) if points else np.empty((0, 3))


def _shrunk(view: DepthView, camera: Camera) -> DepthView:
    size = (camera.width, camera.height)
    grey = cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY).astype(np.float32) * np.float32(1 / 255)
    return replace(view, grey=cv2.resize(grey, size, interpolation=cv2.INTER_AREA))


def _small_mask(view: MapView, camera: Camera) -> Bool[np.ndarray, "h w"]:
    if view.mask is None:
        return np.ones((camera.height, camera.width), bool)
    size = (camera.width, camera.height)
    return cv2.resize(view.mask.cpu().numpy().astype(np.uint8), size) > 0


def _matched_at(
    reference: DepthView, views: Sequence[DepthView], distance: float, config: DepthConfig
) -> list[DepthView]:
    """Neighbours to match with at a distance; none where none is well placed for it."""
    config = replace(config, neighbours=_NEIGHBOURS)
    others = [v for v in views if v.id != reference.id]
    parallax, turn = parallax_degrees(reference, others, distance)
    usable = (parallax > config.min_parallax) & (parallax < config.max_parallax)
    usable &= turn < config.max_turn
    others = [v for v, good in zip(others, usable, strict=True) if good]
    if len(others) < min(2, len(views) - 1):
        return []
    return [others[i] for i in select_sweep_neighbours(reference, others, distance, config)]


def _clear_matches(look: _Look, camera: Camera, config: DepthConfig) -> Float64[np.ndarray, "n 3"]:
    """World points of the pixels with one good match inside the swept range."""
    low, high = 1.0 / (_FAR * look.distance), _NEAR / look.distance
    planes = np.linspace(low, high, _PLANES, dtype=np.float32)
    nothing = np.zeros_like(look.reference.grey)
    swept = plane_sweep(
        look.reference, look.neighbours, camera, planes, nothing + planes[0], nothing, config
    )
    v, u = np.nonzero(_is_clear(swept, low, high) & look.mask)
    local = camera.rays(torch.float64).numpy()[v, u] / swept.inverse_depth[v, u, None]
    T_cw = look.reference.T_cw
    return (local - T_cw[:3, 3]) @ T_cw[:3, :3]


def _is_clear(swept: SweepResult, low: float, high: float) -> Bool[np.ndarray, "h w"]:
    place = (swept.inverse_depth - low) / (high - low)
    inside = (place > _END) & (place < 1.0 - _END)
    return inside & (swept.cost < _MAX_COST) & (swept.margin > _MIN_MARGIN)
