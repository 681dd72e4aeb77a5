"""Selection of the images that make a map: those that cover it from all sides.

The scene is represented by points. An image gains by each point that no chosen image sees yet, and
by each ray at an angle to theirs that allows triangulation. Images are chosen greedily by their
gain, so for any n the first n of the order are a good choice.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64

from geogs.depth.sweep_neighbors import BEST_PARALLAX_DEG, MAX_PARALLAX_DEG
from geogs.geometry.camera import Camera

# Rays per image that make scene points, across and down.
_ACROSS, _DOWN = 4, 3
# Most scene points by default, and the number of their cells that the typical depth spans.
_POINTS, _CELLS = 1000, 10.0
# A point counts as seen at 1/x to x times the typical depth of the image.
_DEPTHS = 3.0
# Least angle between rays that see different sides, degrees.
_SAME_SIDE = 75.0
# Value of a point that one image sees, relative to one that two see well; value of one whose rays
# are too far apart to be matched.
_ALONE, _UNMATCHED = 0.5, 0.5
# Newness below which an image counts as a copy of chosen ones.
_COPY = 0.02
# Nearest images whose detail is compared; least factor of a blurred one.
_ALIKE, _LEAST_SHARP = 6, 0.3


@dataclass(frozen=True, eq=False)
class Sightings:
    """Points of the scene in images, and their rays: one row for each point and image, sorted by
    point."""

    point: Int64[np.ndarray, "s"]
    view: Int64[np.ndarray, "s"]
    ray: Float32[np.ndarray, "s 3"]
    """Unit, from the camera to the point."""
    views: int
    """Number of images."""


def scene_points(
    T_cw: Float64[np.ndarray, "v 4 4"],
    camera: Camera,
    typical: Float64[np.ndarray, "v"],
    random: np.random.Generator,
    most: int = _POINTS,
) -> Float64[np.ndarray, "p 3"]:
    """At most ``most`` evenly spread points of the scene, at the typical depth of each image."""
    u = (np.arange(_ACROSS) + 0.5) / _ACROSS * camera.width
    v = (np.arange(_DOWN) + 0.5) / _DOWN * camera.height
    x, y = np.meshgrid((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
    rays = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], 1)
    local = rays * typical[:, None, None] - T_cw[:, None, :3, 3]
    points = (local @ T_cw[:, :3, :3]).reshape(-1, 3)
    side = float(np.median(typical)) / _CELLS
    _, first = np.unique(np.floor(points / side).astype(np.int64), axis=0, return_index=True)
    if len(first) > most:
        first = random.choice(first, most, replace=False)
    return points[np.sort(first)]


def sightings(
    T_cw: Float64[np.ndarray, "v 4 4"],
    camera: Camera,
    typical: Float64[np.ndarray, "v"],
    points: Float64[np.ndarray, "p 3"],
) -> Sightings:
    """Find the points that each camera sees at about its typical depth."""
    point = []
    view = []
    ray = []
    for i, T in enumerate(T_cw):
        x, y, z = (points @ T[:3, :3].T + T[:3, 3]).T
        ahead = (z > typical[i] / _DEPTHS) & (z < typical[i] * _DEPTHS)
        safe = np.where(ahead, z, 1.0)
        u, v = camera.fx * x / safe + camera.cx, camera.fy * y / safe + camera.cy
        inside = (u > 0) & (v > 0) & (u < camera.width - 1) & (v < camera.height - 1)
        seen = np.flatnonzero(ahead & inside)
        way = points[seen] + T[:3, :3].T @ T[:3, 3]
        point.append(seen)
        view.append(np.full(len(seen), i))
        ray.append((way / np.linalg.norm(way, axis=1, keepdims=True)).astype(np.float32))
    by_point = np.argsort(np.concatenate(point), kind="stable")
    points, images, rays = (np.concatenate(parts)[by_point] for parts in (point, view, ray))
    return Sightings(points, images, rays, len(T_cw))


def coverage_order(
    seen: Sightings, sharpness: Float64[np.ndarray, "v"], copy: float = _COPY
) -> Iterator[int]:
    """Yield image indices, the largest gain first; copies of chosen ones are left out.

    Args:
        seen: the points that each image sees.
        sharpness: factor on the gain of each image, at most 1.
        copy: mean newness of an image's rays up to which it is a copy; the newness of a ray is its
            angle to the nearest chosen one over the best for matching, at most 1.
    """
    points = int(seen.point.max(initial=-1)) + 1
    begin = np.searchsorted(seen.point, np.arange(points + 1))
    by_view = np.argsort(seen.view, kind="stable")
    own = np.searchsorted(seen.view[by_view], np.arange(seen.views + 1))
    nearest = np.full(len(seen.point), -1.0, np.float32)  # cosine to the nearest chosen ray
    newness = np.ones(len(seen.point))
    worth = _ALONE * newness
    sees = np.diff(own).astype(np.float64)
    gain = _ALONE * sees
    fresh = sees.copy()
    count = np.zeros(points, np.int64)
    left = np.ones(seen.views, bool)
    while True:
        left &= (fresh > copy * sees) | (sees == 0)
        if not left.any():
            return
        best = int(np.argmax(np.where(left, gain * sharpness, -1.0)))
        yield best
        left[best] = False
        rows = by_view[own[best] : own[best + 1]]
        some = seen.point[rows]
        count[some] += 1
        sizes = begin[some + 1] - begin[some]
        rivals = np.repeat(begin[some] - np.cumsum(sizes) + sizes, sizes) + np.arange(sizes.sum())
        own_ray = np.repeat(seen.ray[rows], sizes, axis=0)
        cosine = np.einsum("ni,ni->n", seen.ray[rivals], own_ray)
        nearest[rivals] = np.maximum(nearest[rivals], cosine)
        now = _newness(nearest[rivals])
        value = now * np.repeat(_worth(count[some]), sizes)
        of = seen.view[rivals]
        fresh += np.bincount(of, now - newness[rivals], seen.views)
        gain += np.bincount(of, value - worth[rivals], seen.views)
        newness[rivals] = now
        worth[rivals] = value


def _newness(cosine: Float32[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n"]:
    """Newness of a ray by its angle to the nearest chosen one: 0 if it is the same."""
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    matched = np.minimum(angle / BEST_PARALLAX_DEG, 1.0)
    matched = np.where(angle > MAX_PARALLAX_DEG, _UNMATCHED, matched)
    return np.where(angle > _SAME_SIDE, 1.0, matched).astype(np.float64)


def _worth(count: Int64[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n"]:
    """Value of one more ray to points that ``count`` images see; the second ray counts most."""
    return np.where(count == 0, _ALONE, 1.0 / np.maximum(count, 1))


def relative_sharpness(
    T_cw: Float64[np.ndarray, "v 4 4"], typical: float, detail: Sequence[int]
) -> Float64[np.ndarray, "v"]:
    """Ratio of each image's detail to the median of the nearest images; at most 1.

    Args:
        T_cw: poses of the images.
        typical: the typical depth, which makes translations comparable with rotations.
        detail: a measure of it for each image, such as the compressed size.
    """
    own = np.asarray(detail, np.float64)
    if len(own) <= _ALIKE:
        return np.ones(len(own))
    centres = -(np.swapaxes(T_cw[:, :3, :3], 1, 2) @ T_cw[:, :3, 3:])[:, :, 0]
    places = np.concatenate([centres / typical, T_cw[:, 2, :3]], 1)
    usual = np.empty(len(own))
    for i, place in enumerate(places):
        around = np.argpartition(((places - place) ** 2).sum(1), _ALIKE)[: _ALIKE + 1]
        usual[i] = np.median(own[around])
    return np.clip(own / np.maximum(usual, 1e-12), _LEAST_SHARP, 1.0)
