"""Points from features seen in several images with known poses, all of them at once."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

_ROUNDS = 8


@dataclass(frozen=True)
class Observations:
    """Where images see points; ordered by point."""

    point: Int64[np.ndarray, "m"]
    """0, 1, 2, ... without gaps."""
    view: Int64[np.ndarray, "m"]
    pixel: Float64[np.ndarray, "m 2"]

    @property
    def points(self) -> int:
        """Number of points."""
        return int(self.point[-1]) + 1 if len(self.point) else 0

    def only(self, kept: Bool[np.ndarray, "m"]) -> "Observations":
        """These observations alone, points renumbered in their order."""
        point = np.unique(self.point[kept], return_inverse=True)[1].astype(np.int64)
        return Observations(point, self.view[kept], self.pixel[kept])


@dataclass(frozen=True)
class Projections:
    """Rays and projections for observations of posed cameras."""

    T_cw: Float64[np.ndarray, "v 4 4"]
    intrinsics: Float64[np.ndarray, "v 4"]
    """fx, fy, cx, cy of every view."""

    def rays(self, seen: Observations) -> Float64[np.ndarray, "m 3"]:
        """Unit directions in the world."""
        fx, fy, cx, cy = self.intrinsics[seen.view].T
        x, y = (seen.pixel[:, 0] - cx) / fx, (seen.pixel[:, 1] - cy) / fy
        local = np.stack([x, y, np.ones_like(x)], 1)
        local /= np.linalg.norm(local, axis=1, keepdims=True)
        return np.einsum("mji,mj->mi", self.T_cw[seen.view, :3, :3], local)

    def centres(self) -> Float64[np.ndarray, "v 3"]:
        """Places of the cameras."""
        return -np.einsum("nji,nj->ni", self.T_cw[:, :3, :3], self.T_cw[:, :3, 3])

    def local(
        self, points: Float64[np.ndarray, "n 3"], seen: Observations
    ) -> Float64[np.ndarray, "m 3"]:
        """Each observation's point in the frame of its camera."""
        T = self.T_cw[seen.view]
        return np.einsum("mij,mj->mi", T[:, :3, :3], points[seen.point]) + T[:, :3, 3]

    def errors(
        self, points: Float64[np.ndarray, "n 3"], seen: Observations
    ) -> Float64[np.ndarray, "m"]:
        """Distance in pixels of the projection; infinite behind the camera."""
        local = self.local(points, seen)
        fx, fy, cx, cy = self.intrinsics[seen.view].T
        z = np.where(local[:, 2] > 0, local[:, 2], np.nan)
        u, v = fx * local[:, 0] / z + cx, fy * local[:, 1] / z + cy
        error = np.hypot(u - seen.pixel[:, 0], v - seen.pixel[:, 1])
        return np.where(np.isfinite(error), error, np.inf)


def triangulate(
    projections: Projections, seen: Observations, max_error: float
) -> Float64[np.ndarray, "n 3"]:
    """The point nearest to its rays, weighted so that errors count in pixels.

    Iteratively reweighted least squares: a ray at distance r of a point at depth z misses by
    about f r / z pixels; observations far beyond ``max_error`` hardly count (Geman-McClure).
    Points whose rays are parallel are not finite.
    """
    rays, origins = projections.rays(seen), projections.centres()[seen.view]
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    weight = np.ones(len(seen.point))
    points = np.zeros((seen.points, 3))
    for _ in range(_ROUNDS):
        normal = _sums(seen, weight[:, None, None] * across)
        side = _sums(seen, weight[:, None] * np.einsum("mij,mj->mi", across, origins))
        points = _solve(normal, side)
        offset = points[seen.point] - origins
        depth = np.linalg.norm(offset, axis=1)
        miss = np.linalg.norm(np.einsum("mij,mj->mi", across, offset), axis=1)
        pixels = projections.intrinsics[seen.view, 0] * miss / depth
        weight = 1 / (depth * (1 + (pixels / max_error) ** 2)) ** 2
        weight = np.where(np.isfinite(weight), weight, 0.0)
    return points


def largest_parallax(
    projections: Projections, points: Float64[np.ndarray, "n 3"], seen: Observations
) -> Float64[np.ndarray, "n"]:
    """Largest angle in degrees between two rays of each point."""
    ray = points[seen.point] - projections.centres()[seen.view]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    cosine = np.ones(seen.points)
    longest = int(np.bincount(seen.point).max()) if len(seen.point) else 0
    for shift in range(1, longest):
        same = seen.point[shift:] == seen.point[:-shift]
        pair = np.einsum("mi,mi->m", ray[shift:][same], ray[:-shift][same])
        np.minimum.at(cosine, seen.point[shift:][same], pair)
    return np.degrees(np.arccos(cosine.clip(-1, 1)))


def _sums(seen: Observations, values: Float64[np.ndarray, "m ..."]) -> np.ndarray:
    """Sum over the observations of each point."""
    flat = values.reshape(len(values), -1)
    columns = [np.bincount(seen.point, column, seen.points) for column in flat.T]
    return np.stack(columns, 1).reshape(seen.points, *values.shape[1:])


def _solve(
    normal: Float64[np.ndarray, "n 3 3"], side: Float64[np.ndarray, "n 3"]
) -> Float64[np.ndarray, "n 3"]:
    scale = np.trace(normal, axis1=1, axis2=2)
    regular = np.linalg.det(normal / np.where(scale > 0, scale, 1)[:, None, None]) > 1e-12
    points = np.full(side.shape, np.nan)
    points[regular] = np.linalg.solve(normal[regular], side[regular][..., None])[..., 0]
    return points
