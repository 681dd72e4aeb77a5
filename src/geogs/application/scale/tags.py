"""The scale by square tags of known size: found in keyframes, their corners triangulated."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

from geogs.application.scale.measurable_scene import MeasurableScene
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.types import MetricScale

MIN_PARALLAX = np.radians(1.5)
"""Least angle between two rays to a corner."""
MAX_REPROJECTION_ERROR = 3.0
"""Largest reprojection error of a triangulated corner, in pixels."""

Corners = Float64[np.ndarray, "4 2"]
Sighting = tuple[Float64[np.ndarray, "4 4"], Corners]
"""World to camera, and the corners' pixels."""


@dataclass(frozen=True)
class TagSize:
    """Square tags of one family, with the side length of their black squares."""

    family: str
    """Name of OpenCV's dictionary."""
    metres: float


def scale_by_tags(scene: MeasurableScene, known: TagSize) -> MetricScale:
    """The median scale of all sides and diagonals of all tags.

    Raises:
        InputError: OpenCV has no such family, or no tag is seen from two positions.
    """
    seen: dict[int, list[Sighting]] = defaultdict(list)
    detect = TagDetector(known.family)
    for keyframe in scene.keyframes:
        if keyframe.image is not None:
            for id, corners in detect(keyframe.image).items():
                seen[id].append((keyframe.T_cw, corners))
    sizes: list[float] = []
    tags = views = 0
    for sightings in seen.values():
        points = [
            triangulated(scene.camera, [(T, corners[k]) for T, corners in sightings])
            for k in range(4)
        ]
        found = _sides(points)
        sizes += found
        if found:
            tags = tags + 1
            views = views + len(sightings)
    if not sizes:
        what = f"seen, but in too few places ({len(seen)} of them)" if seen else "found"
        raise InputError(
            f"--scale-from: no tag of {known.family} was {what}; record it larger and from several "
            "sides, or say another family."
        )
    middle = float(np.median(sizes))
    spread = 1.4826 * float(np.median(np.abs(np.array(sizes) - middle))) / middle
    # Common relative error of all tag sizes, by printing, focal length and blur.
    deviation = float(np.hypot(spread / max(tags, 1) ** 0.5 / 2, 0.003))
    origin = f"{tags} tag{'s' * (tags > 1)} of {known.metres:g} m in {views} sightings"
    return MetricScale(origin, known.metres / middle, deviation)


class TagDetector:
    """Finds the tags of a family in images."""

    def __init__(self, family: str) -> None:
        """Raises InputError if OpenCV has no such family."""
        number = getattr(cv2.aruco, family, None)
        if not isinstance(number, int):
            raise InputError(
                f"--scale-from: OpenCV knows no tags called {family[:40]}; DICT_4X4_50, "
                "DICT_5X5_50 and DICT_APRILTAG_36h11 are some."
            )
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_CONTOUR
        dictionary = cv2.aruco.getPredefinedDictionary(number)
        self._detector = cv2.aruco.ArucoDetector(dictionary, parameters)

    def __call__(self, image: UInt8[np.ndarray, "h w 3"]) -> dict[int, Corners]:
        """The corners of each tag by its number, in its own order; those seen twice are left out.

        They are the sub-pixel intersections of the edges' lines.
        """
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        corners, ids, _ = self._detector.detectMarkers(grey)
        numbers = [] if ids is None else [int(id) for id in np.ravel(ids)]
        found = zip(numbers, corners, strict=True)
        return {
            id: refined(grey, np.asarray(c, np.float64).reshape(4, 2))
            for id, c in found
            if numbers.count(id) == 1
        }


def refined(grey: UInt8[np.ndarray, "h w"], corners: Corners) -> Corners:
    """Refine corners to the intersections of the lines of steepest gradient along the edges.

    Unchanged where an edge is too short or too faint.
    """
    lines = []
    for k in range(4):
        line = _edge_line(grey, corners[k], corners[(k + 1) % 4])
        if line is None:
            return corners
        lines.append(line)
    meet = np.array([np.cross(lines[k - 1], lines[k]) for k in range(4)])
    if (np.abs(meet[:, 2]) < 1e-9).any():
        return corners
    moved = meet[:, :2] / meet[:, 2:]
    return moved if np.abs(moved - corners).max() < 2.0 else corners


def _edge_line(
    grey: UInt8[np.ndarray, "h w"], a: Float64[np.ndarray, "2"], b: Float64[np.ndarray, "2"]
) -> Float64[np.ndarray, "3"] | None:
    """The line through the steepest pixels across an edge from a to b, homogeneous."""
    length = float(np.linalg.norm(b - a))
    count = int(length)
    if count < 8:
        return None
    along = (b - a) / length
    across = np.array([-along[1], along[0]])
    at = np.linspace(0.12, 0.88, count)[:, None] * (b - a) + a
    reach = np.arange(-3, 3.01, 0.25)
    pixels = (at[:, None] + reach[:, None] * across).astype(np.float32)
    values = cv2.remap(grey.astype(np.float32), pixels[..., 0], pixels[..., 1], cv2.INTER_LINEAR)
    slope = np.abs(np.gradient(cv2.blur(values, (3, 1)), axis=1))
    total = slope.sum(1)
    if total.min() <= 0:
        return None
    # The middle of the step: its centroid, after subtraction of the flanks' noise.
    slope = np.maximum(slope - np.median(slope, 1, keepdims=True), 0)
    if (slope.sum(1) <= 0).any():
        return None
    offset = (slope * reach).sum(1) / slope.sum(1)
    points = at + offset[:, None] * across
    good = np.abs(offset - np.median(offset)) < 1.0
    centre = points[good].mean(0)
    direction = np.linalg.svd(points[good] - centre)[2][0]
    normal = np.array([-direction[1], direction[0]])
    return np.append(normal, -normal @ centre)


def triangulated(
    camera: Camera, rays: Sequence[tuple[Float64[np.ndarray, "4 4"], Float64[np.ndarray, "2"]]]
) -> Float64[np.ndarray, "3"] | None:
    """Triangulate a world point from pixels in several views; None if the views are too close.

    Linear, weighted by distance so that errors are in pixels, without outlier views.
    """
    K = camera.matrix().numpy()
    P = np.array([K @ T[:3] for T, _ in rays])
    pixels = np.array([p for _, p in rays])
    used = np.ones(len(P), bool)
    depth = np.ones(len(P))
    point = np.zeros(3)
    for _ in range(4):
        if used.sum() < 2:
            return None
        A = np.concatenate(
            [(pixels[:, k, None] * P[:, 2] - P[:, k])[used] / depth[used, None] for k in (0, 1)]
        )
        point = -np.linalg.lstsq(A[:, :3], A[:, 3], rcond=None)[0]
        seen = P @ np.append(point, 1.0)
        depth = np.where(seen[:, 2] > 0, seen[:, 2], 1.0)
        error = np.linalg.norm(seen[:, :2] / depth[:, None] - pixels, axis=1)
        used = (seen[:, 2] > 0) & (error < max(MAX_REPROJECTION_ERROR, 3 * float(np.median(error))))
    centres = np.array([-T[:3, :3].T @ T[:3, 3] for T, _ in rays])[used]
    towards = point - centres
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    widest = np.arccos(np.clip(towards @ towards.T, -1, 1)).max(initial=0.0)
    return point if widest > MIN_PARALLAX else None


def _sides(points: Sequence[Float64[np.ndarray, "3"] | None]) -> list[float]:
    """Lengths of a tag's side by its four sides and two diagonals, map units."""
    found = []
    for a, b in combinations(range(4), 2):
        first, second = points[a], points[b]
        if first is not None and second is not None:
            diagonal = 2**0.5 if b - a == 2 else 1.0
            found.append(float(np.linalg.norm(first - second)) / diagonal)
    return found
