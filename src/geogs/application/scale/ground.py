"""The scale by the camera's height: the ground is the plane under its path."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from geogs.application.scale.measurable_scene import MeasurableScene
from geogs.errors import InputError
from geogs.types import MetricScale

MAX_VIEWS = 40
"""Largest number of keyframes whose surfaces are used."""
POINTS_PER_VIEW = 400
"""Number of points of each keyframe."""
MAX_TILT = np.radians(35.0)
"""Largest angle between the ground's normal and the mean of the cameras' upward axes."""
MAX_DISTANCE = 0.02
"""Largest distance of a ground point from the plane, relative to the cameras' height."""
_SAMPLES = 1000
_MAX_SCORED = 3000
"""Largest number of points to score a plane by."""
_MAX_BELOW = 0.05
"""Largest fraction of points clearly below the ground."""
_MIN_SUPPORT = 0.03
"""Least fraction of points on the ground."""


@dataclass(frozen=True)
class CameraHeight:
    """Median height of the camera over the ground."""

    metres: float


def scale_by_height(scene: MeasurableScene, known: CameraHeight) -> MetricScale:
    """The median height of the keyframes over the ground, which is found by RANSAC.

    The deviation is the spread of the heights over the path: a hand-held camera moves up and down.

    Raises:
        InputError: there is no such plane.
    """
    step = max(1, -(-len(scene.keyframes) // MAX_VIEWS))
    poses = np.array([k.T_cw for k in scene.keyframes])
    if not len(poses):
        raise InputError("--scale-from: there is no keyframe, and so no ground.")
    rng = np.random.default_rng(0)
    clouds = []
    for T_cw in poses[::step]:
        points, _ = scene.points(T_cw)
        chosen = rng.choice(len(points), min(POINTS_PER_VIEW, len(points)), replace=False)
        clouds.append(points[chosen])
    cloud = np.concatenate(clouds)
    centres = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    up = -poses[:, 1, :3].mean(0)
    plane = ground_plane(cloud, centres, up, rng)
    if plane is None:
        raise InputError(
            "--scale-from: no ground was found under the camera's path; let it be seen, or give "
            "another known length."
        )
    heights = centres @ plane[:3] + plane[3]
    height = float(np.median(heights))
    spread = 1.4826 * float(np.median(np.abs(heights - height))) / height
    origin = f"a camera height of {known.metres:g} m"
    return MetricScale(origin, known.metres / height, float(np.hypot(spread, 0.005)))


def ground_plane(
    cloud: Float64[np.ndarray, "n 3"],
    centres: Float64[np.ndarray, "k 3"],
    up: Float64[np.ndarray, "3"],
    rng: np.random.Generator,
) -> Float64[np.ndarray, "4"] | None:
    """Unit normal n, upward, and offset of the plane ``n . x + offset = 0`` below all cameras.

    The one with most points among those with hardly any points below; None if there is none.
    """
    if len(cloud) < 3:
        return None
    up = up / max(float(np.linalg.norm(up)), 1e-12)
    judges = cloud[rng.permutation(len(cloud))[:_MAX_SCORED]]
    best, most = None, _MIN_SUPPORT * len(judges)
    for a, b, c in cloud[rng.integers(len(cloud), size=(_SAMPLES, 3))]:
        plane = _through(a, b, c, up)
        count = 0.0 if plane is None else _support(plane, judges, centres)
        if count > most:
            best, most = plane, count
    if best is None:
        return None
    for _ in range(3):
        height = float(np.median(centres @ best[:3] + best[3]))
        near = cloud[np.abs(cloud @ best[:3] + best[3]) < MAX_DISTANCE * height]
        middle = near.mean(0)
        normal = np.linalg.svd(near - middle, full_matrices=False)[2][2]
        normal = normal if normal @ up > 0 else -normal
        best = np.append(normal, -normal @ middle)
    return best


def _through(
    a: Float64[np.ndarray, "3"],
    b: Float64[np.ndarray, "3"],
    c: Float64[np.ndarray, "3"],
    up: Float64[np.ndarray, "3"],
) -> Float64[np.ndarray, "4"] | None:
    normal = np.cross(b - a, c - a)
    length = float(np.linalg.norm(normal))
    if length < 1e-12:
        return None
    normal = normal / length if normal @ up > 0 else -normal / length
    return np.append(normal, -normal @ a) if normal @ up > np.cos(MAX_TILT) else None


def _support(
    plane: Float64[np.ndarray, "4"],
    cloud: Float64[np.ndarray, "n 3"],
    centres: Float64[np.ndarray, "k 3"],
) -> float:
    """Number of points on a plane; 0 where a camera is not above it, or many points lie below."""
    heights = centres @ plane[:3] + plane[3]
    height = float(np.median(heights))
    if heights.min() <= 0:
        return 0.0
    above = cloud @ plane[:3] + plane[3]
    if (above < -4 * MAX_DISTANCE * height).mean() > _MAX_BELOW:
        return 0.0
    return float((np.abs(above) < MAX_DISTANCE * height).sum())
