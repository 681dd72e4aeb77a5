"""Depth ranges of views with known poses, in place of a tracker's depths."""

from collections.abc import Iterable, Sequence

import numpy as np
import torch
from jaxtyping import Float64

from geogs.depth.depth_view import ViewPose
from geogs.depth.sweep_neighbors import RANGE_MARGIN
from geogs.geometry.camera import Camera
from geogs.mapping.keyframe_views import MapView
from geogs.world.map import DepthSearch

FEWEST_POINTS = 100
"""Least number of points, over all views, that locate the scene."""
# Least number of points in a view that determine its range.
_ENOUGH_POINTS = 50
# Most points for the ranges of all views; more would not change them.
_MOST_POINTS = 20_000
# Points taken from each dense depth.
_POINTS_PER_VIEW = 2000
# Least confidence of a pixel that gives a point.
_CONFIDENT = 0.7


def depth_search(
    view: ViewPose, points: Float64[np.ndarray, "n 3"], camera: Camera, margin: float
) -> DepthSearch:
    """Depth range of a view: that of the points it sees, widened by ``margin``.

    If it sees few, that of all points in front of it.
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
    views: Iterable[MapView], points: Float64[np.ndarray, "n 3"], camera: Camera
) -> None:
    """Set every view's search range from these points; the depths of its grid are not used."""
    points = points[:: 1 + len(points) // _MOST_POINTS]
    for view in views:
        view.row.search = depth_search(view.view_pose, points, camera, RANGE_MARGIN)


def dense_points(
    views: Sequence[MapView], camera: Camera, random: np.random.Generator
) -> Float64[np.ndarray, "n 3"]:
    """World points of some pixels of each view where its depth is confident."""
    rays = camera.rays(torch.float64).numpy()
    points = []
    for view in views:
        depth = view.dense.arrays()
        v, u = np.nonzero(depth.confidence >= _CONFIDENT)
        some = random.permutation(len(v))[:_POINTS_PER_VIEW]
        local = rays[v[some], u[some]] * depth.depth[v[some], u[some], None]
        T_cw = view.view_pose.T_cw
        points.append((local - T_cw[:3, 3]) @ T_cw[:3, :3])
    return np.concatenate(points) if points else np.empty((0, 3))
