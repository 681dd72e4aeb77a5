"""Points of the scene from plane sweeps over a few small images with known poses.

Without a tracker the distance of the scene is not known. A few small images are swept over depth
ranges around growing distances, each with neighbours that suit the distance; at the right one many
pixels match. Only images that are swept or matched are read.
"""

from collections.abc import Callable, Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float64, UInt8

from geogs.depth.depth_view import DepthView, ViewPose
from geogs.depth.plane_sweep import SweepResult, plane_sweep
from geogs.depth.sweep_neighbors import (
    MAX_PARALLAX_DEG,
    MIN_PARALLAX_DEG,
    select_sweep_neighbours,
    view_pairs,
)
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.mapping.known_poses import FEWEST_POINTS
from geogs.threads import thread_map

EDGE = 128
"""Longer side of the images, pixels."""
IMAGES = 8
"""Images whose depth is searched."""
# A sweep around a distance d goes from d / NEAR to d * FAR; the next distance is RATIO times d.
_NEAR, _FAR, _RATIO = 3.0, 6.0, 2.5
# Parallax in degrees of the nearest two cameras at the first distance, of the farthest at the last.
_WIDEST, _NARROWEST = 25.0, 1.5
_NEIGHBOURS, _PLANES = 6, 64
# Images swept at every distance; the others only at the best distance and the two next to it.
_SCOUTS = 3
# Most images among which distances and neighbours are chosen.
_CANDIDATES = 200
# Highest cost of a match that counts, and least margin to the next best plane.
_MAX_COST, _MIN_MARGIN = 0.3, 1.0
# Least fraction of pixels that match. Measured: 0.4 to 0.9 where poses are right, below
# 0.06 with camera-to-world in place of world-to-camera.
_LEAST_CLEAR = 0.05
# Fraction of the range at each end that is not used: planes there win for all that lies beyond.
_END = 0.04

SmallImage = tuple[UInt8[np.ndarray, "h w 3"], Bool[np.ndarray, "mh mw"] | None]
"""An image of any size, and a mask of the pixels that count, if not all do."""


def distances_to_try(views: Sequence[ViewPose]) -> Float64[np.ndarray, "n"]:
    """Typical depths that images from these poses could show, in a geometric series.

    Empty where all cameras have the same centre, so that there is no parallax.
    """
    centres = np.stack([v.center for v in views])
    distance = np.linalg.norm(centres[:, None] - centres, axis=2)
    extent = distance.max()
    if extent <= 1e-9 * max(1.0, float(np.abs(centres).max())):
        return np.empty(0)
    nearest = np.where(distance > 1e-6 * extent, distance, np.inf).min(1)
    first = float(np.median(nearest)) / np.tan(np.radians(_WIDEST))
    last = extent / np.tan(np.radians(_NARROWEST))
    count = 2 + int(np.log(last / first) / np.log(_RATIO))
    return first * _RATIO ** np.arange(count)


def first_points(
    poses: Sequence[ViewPose],
    image_at: Callable[[int], SmallImage],
    working: Camera,
    progress: Callable[[float], None],
) -> Float64[np.ndarray, "n 3"]:
    """World points of clear matches at the distance where most pixels have one.

    Args:
        poses: poses of the images; their ids are their indices in this sequence.
        image_at: reads an image by its id.
        working: the camera of the images, of any size.
        progress: called with the finished fraction.

    Raises:
        InputError: hardly anything matches anywhere.
    """
    look = _FirstLook(poses, image_at, working)
    chosen = _spread(len(poses), IMAGES)
    scouts = [chosen[i] for i in _spread(len(chosen), _SCOUTS)]
    distances = distances_to_try([poses[i] for i in _spread(len(poses), _CANDIDATES)])
    tasks = [(i, float(d)) for d in distances for i in scouts]
    part = len(tasks) / max(len(tasks) + 3 * (len(chosen) - len(scouts)), 1)
    found = look.points(tasks, lambda f: progress(part * f))
    best = max(range(len(distances)), key=lambda k: _count(found, float(distances[k])), default=0)
    others = [i for i in chosen if i not in scouts]
    tasks = [(i, float(d)) for d in distances[max(best - 1, 0) : best + 2] for i in others]
    found |= look.points(tasks, lambda f: progress(part + (1 - part) * f))
    wanted = max(distances.tolist(), key=lambda d: _count(found, d), default=0.0)
    points = [p for (_, d), p in found.items() if d == wanted]
    gathered = np.concatenate(points) if points else np.empty((0, 3))
    if len(gathered) < max(FEWEST_POINTS, _LEAST_CLEAR * look.pixels(chosen)):
        raise InputError(
            "No two images show the same surface from two places where their poses say; are the "
            "poses, their axes and the intrinsics those of these images?"
        )
    return gathered


Found = dict[tuple[int, float], Float64[np.ndarray, "n 3"]]
"""World points by image and distance."""


def _count(found: Found, distance: float) -> int:
    return sum(len(points) for (_, d), points in found.items() if d == distance)


def _spread(count: int, most: int) -> list[int]:
    """At most ``most`` numbers below ``count``, evenly spread, first and last among them."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).astype(int)).tolist()


class _FirstLook:
    """Small images, each read once when it is first needed, and sweeps over them."""

    def __init__(
        self, poses: Sequence[ViewPose], image_at: Callable[[int], SmallImage], working: Camera
    ) -> None:
        self._poses = poses
        self._image_at = image_at
        edge = min(EDGE, max(working.width, working.height))
        self._camera = working.with_long_edge(edge)
        self._small: dict[int, tuple[DepthView, Bool[np.ndarray, "h w"]]] = {}

    def points(
        self, tasks: Sequence[tuple[int, float]], progress: Callable[[float], None]
    ) -> Found:
        """Clear matches of images around distances, where there are suitable neighbours."""
        matched = {task: self._matched_at(*task) for task in tasks}
        looks = {
            (i, d): (*self._read(i), [self._read(k)[0] for k in others], d)
            for (i, d), others in matched.items()
            if others
        }
        clear = thread_map(
            lambda look: _clear_matches(*look, self._camera), list(looks.values()), progress
        )
        return dict(zip(looks, clear, strict=True))

    def pixels(self, images: Sequence[int]) -> int:
        """Number of pixels inside the masks of some images."""
        return sum(int(self._read(i)[1].sum()) for i in images)

    def _read(self, index: int) -> tuple[DepthView, Bool[np.ndarray, "h w"]]:
        if index not in self._small:
            image, mask = self._image_at(index)
            size = (self._camera.width, self._camera.height)
            large = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
            grey = cv2.resize(large * np.float32(1 / 255), size, interpolation=cv2.INTER_AREA)
            colours = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
            unknown = np.zeros((1, 1), np.float32)
            place = self._poses[index]
            inside = np.ones(grey.shape, bool)
            if mask is not None:
                inside = cv2.resize(mask.astype(np.uint8), size) > 0
            view = DepthView(place.id, place.T_cw, grey, grey, colours, unknown, unknown)
            self._small[index] = (view, inside)
        return self._small[index]

    def _matched_at(self, index: int, distance: float) -> list[int]:
        """Images to match one with at a distance; empty where none is suitable."""
        reference = self._poses[index]
        others = [p for p in self._poses if p.id != reference.id]
        if not others:
            return []
        pairs = view_pairs(reference, others, distance, self._camera)
        usable = pairs.usable(MIN_PARALLAX_DEG, MAX_PARALLAX_DEG)
        others = [p for p, good in zip(others, usable, strict=True) if good]
        if len(others) < min(2, len(self._poses) - 1):
            return []
        chosen = select_sweep_neighbours(reference, others, distance, self._camera, _NEIGHBOURS)
        return [others[i].id for i in chosen]


def _clear_matches(
    reference: DepthView,
    mask: Bool[np.ndarray, "h w"],
    neighbours: list[DepthView],
    distance: float,
    camera: Camera,
) -> Float64[np.ndarray, "n 3"]:
    """World points of the pixels with one good match inside the range around a distance."""
    low, high = 1.0 / (_FAR * distance), _NEAR / distance
    planes = np.linspace(low, high, _PLANES, dtype=np.float32)
    nothing = np.zeros_like(reference.grey)
    swept = plane_sweep(reference, neighbours, camera, planes, nothing + planes[0], nothing)
    v, u = np.nonzero(_is_clear(swept, low, high) & mask)
    local = camera.rays(torch.float64).numpy()[v, u] / swept.inverse_depth[v, u, None]
    T_cw = reference.T_cw
    return (local - T_cw[:3, 3]) @ T_cw[:3, :3]


def _is_clear(swept: SweepResult, low: float, high: float) -> Bool[np.ndarray, "h w"]:
    place = (swept.inverse_depth - low) / (high - low)
    inside = (place > _END) & (place < 1.0 - _END)
    return inside & (swept.cost < _MAX_COST) & (swept.margin > _MIN_MARGIN)
