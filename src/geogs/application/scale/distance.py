"""The scale by known distances between points: pixels of a frame, lifted by the map's depth."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from geogs.application.scale.measurable_scene import MeasurableScene
from geogs.camera.distortion import undistorted_rays
from geogs.errors import InputError
from geogs.io.sources.calibration import Calibration
from geogs.types import MetricScale

CLICK_ERROR = 1.0
"""Error of a given point, in pixels of the stored image."""
_RADIUS = 2
"""Half-width of the window of the depth map around a point, in pixels."""


@dataclass(frozen=True)
class KnownDistance:
    """Two pixels of a frame with the distance of their points."""

    frame: int
    """Number of the frame in the source's selection, from 0."""
    first: tuple[float, float]
    """Column and row in the stored image, upright."""
    second: tuple[float, float]
    metres: float


@dataclass(frozen=True)
class KnownDistances:
    """Several distances, which are averaged."""

    each: tuple[KnownDistance, ...]


def scale_by_distances(
    scene: MeasurableScene, known: KnownDistances, calibration: Calibration
) -> MetricScale:
    """The mean scale of the distances, weighted by their inverse variances.

    Args:
        scene: the map to scale.
        known: pixels of stored images.
        calibration: camera of these images.

    Raises:
        InputError: a frame or a pixel does not exist, or the map has no depth at it.
    """
    each = [_one(scene, one, calibration) for one in known.each]
    factors, deviations = np.array(each).T
    weight = deviations**-2.0
    factor = float((weight * factors).sum() / weight.sum())
    deviation = weight.sum() ** -0.5
    if len(each) > 1:  # their disagreement includes errors that depth maps do not report
        chi = float((weight * (factors - factor) ** 2).sum() / (len(each) - 1))
        deviation *= max(1.0, chi) ** 0.5
    count = "a known distance" if len(each) == 1 else f"{len(each)} known distances"
    return MetricScale(count, factor, float(deviation / factor))


def _one(
    scene: MeasurableScene, known: KnownDistance, calibration: Calibration
) -> tuple[float, float]:
    """Metres per map unit by one distance, and its deviation."""
    trajectory = scene.trajectory
    if known.frame >= len(trajectory.T_wc) or not trajectory.tracked[known.frame]:
        raise InputError(
            f"--scale-from: frame {known.frame} has no place; give one of the "
            f"{len(trajectory.T_wc)} frames that was tracked."
        )
    depth = scene.surface(np.linalg.inv(trajectory.T_wc[known.frame]))
    both = np.array([known.first, known.second])
    rays = undistorted_rays(both, calibration.camera(), calibration.distortion, calibration.lens)
    ends, along = zip(*(_lifted(scene, depth, ray, known) for ray in rays), strict=True)
    between = ends[1] - ends[0]
    length = float(np.linalg.norm(between))
    focal = calibration.fx
    variance = 0.0
    for point, ray, deviation in zip(ends, rays, along, strict=True):
        variance += (CLICK_ERROR * point[2] / focal) ** 2
        towards = np.append(ray, 1.0) @ between / length
        variance += (towards * deviation) ** 2
    return known.metres / length, known.metres / length * variance**0.5 / length


def _lifted(
    scene: MeasurableScene,
    depth: Float64[np.ndarray, "h w"],
    ray: Float64[np.ndarray, "2"],
    known: KnownDistance,
) -> tuple[Float64[np.ndarray, "3"], float]:
    """The point on a ray in the camera, and the deviation of its depth.

    Inverse depth is fitted by a plane to the pixels around, without those of another surface.
    """
    camera = scene.depth_camera
    u, v = ray[0] * camera.fx + camera.cx, ray[1] * camera.fy + camera.cy
    column, row = round(float(u)), round(float(v))
    if not (0 <= column < camera.width and 0 <= row < camera.height):
        raise InputError(f"--scale-from: a pixel lies outside the working image of {known.frame}.")
    rows = slice(max(row - _RADIUS, 0), row + _RADIUS + 1)
    columns = slice(max(column - _RADIUS, 0), column + _RADIUS + 1)
    y, x = np.mgrid[rows, columns]
    y, x = y[: depth[rows, columns].shape[0]], x[:, : depth[rows, columns].shape[1]]
    near = depth[rows, columns]
    middle = np.median(near[near > 0]) if (near > 0).any() else 0.0
    used = (near > 0) & (np.abs(near - middle) < 0.05 * middle)
    if used.sum() < 4:
        raise InputError(
            f"--scale-from: the map has no depth at a pixel of frame {known.frame}; give points "
            "on surfaces that are mapped."
        )
    A = np.stack([np.ones(used.sum()), x[used] - u, y[used] - v], 1)
    inverse = 1 / near[used]
    fit = np.linalg.lstsq(A, inverse, rcond=None)[0]
    z = 1 / fit[0]
    noise = float(np.sqrt(np.mean((A @ fit - inverse) ** 2))) * z * z
    return np.append(ray, 1.0) * z, max(noise, 1e-3 * z)
