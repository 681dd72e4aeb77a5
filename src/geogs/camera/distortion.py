"""OpenCV's lens distortion: from rays to the pixels of a distorted image, and back.

A *polynomial* lens distorts the plane z = 1 by k1, k2, p1, p2(, k3(, k4, k5, k6)). A *fisheye*
(Kannala and Brandt, "A generic camera model and calibration method for conventional, wide-angle,
and fish-eye lenses", PAMI 2006) maps a ray at the angle a from its axis to the radius
a (1 + k1 a^2 + k2 a^4 + k3 a^6 + k4 a^8); without coefficients the radius is the angle.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float

from geogs.geometry.camera import Camera

LensModel = Literal["polynomial", "fisheye"]
USUAL_BEND = 0.1, 0.2
"""Prior standard deviations of k1 and k2 of an uncalibrated polynomial lens."""
RESAMPLING = cv2.INTER_LANCZOS4
"""Interpolation of straightened images. OpenCV's cubic (a = -3/4, which does not preserve a slope)
would shift image content by up to 0.04 pixels, most at a quarter of a pixel; the offsets of a
rolling shutter's rows pass through all such fractions."""
FISHEYE_LIMIT = np.radians(88.0)
"""Angle from the axis up to which the plane z = 1 is used; rays beyond are clamped to it."""


def distorted_pixels(
    rays: Float[np.ndarray, "n 2"],
    camera: Camera,
    distortion: Sequence[float],
    lens: LensModel = "polynomial",
) -> Float[np.ndarray, "n 2"]:
    """Project rays x/z, y/z into the image of a lens.

    ``camera`` is its pinhole part; ``distortion`` holds OpenCV's coefficients, none for a pinhole
    or a fisheye whose radius is the angle.
    """
    if lens == "fisheye":
        radius = np.linalg.norm(rays, axis=1, keepdims=True)
        bent = _bent(np.arctan(radius), distortion)
        rays = rays * np.divide(bent, radius, out=np.ones_like(bent), where=radius > 1e-12)
    elif any(distortion):
        points = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
        coefficients = np.array(distortion, dtype=np.float64)
        pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.K, coefficients)
        return pixels[:, 0]
    return rays * (camera.fx, camera.fy) + (camera.cx, camera.cy)


def undistorted_rays(
    pixels: Float[np.ndarray, "n 2"],
    camera: Camera,
    distortion: Sequence[float],
    lens: LensModel = "polynomial",
) -> Float[np.ndarray, "n 2"]:
    """Return the rays x/z, y/z of pixels in the image of a lens: the inverse of the above.

    Fisheye rays farther than ``FISHEYE_LIMIT`` from the axis are clamped to it.
    """
    plane = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    if lens == "fisheye":
        bent = np.linalg.norm(plane, axis=1, keepdims=True)
        radius = np.tan(_straight(bent, distortion))
        return plane * np.divide(radius, bent, out=np.ones_like(bent), where=bent > 1e-12)
    if not any(distortion):
        return plane
    coefficients = np.array(distortion, dtype=np.float64)
    points = np.ascontiguousarray(pixels, dtype=np.float64)[:, None]
    rays = cv2.undistortPoints(points, camera.K, coefficients)[:, 0]
    for _ in range(8):  # OpenCV's own few rounds leave visible errors
        rays = rays + (pixels - distorted_pixels(rays, camera, distortion)) / (camera.fx, camera.fy)
    return rays


def lens_maps(
    target: Camera, source: Camera, distortion: Sequence[float], lens: LensModel
) -> tuple[np.ndarray, np.ndarray]:
    """Return column and row in the image of a lens for each pixel of a pinhole, float32."""
    K = source.K
    target_K = target.K
    size = (target.width, target.height)
    D = np.array(distortion or (0.0,) * 4, dtype=np.float64)
    if lens == "fisheye":
        maps = cv2.fisheye.initUndistortRectifyMap(K, D, np.eye(3), target_K, size, cv2.CV_32FC1)
    else:
        maps = cv2.initUndistortRectifyMap(K, D, None, target_K, size, cv2.CV_32FC1)
    return maps[0], maps[1]


def with_bend(
    camera: Camera,
    distortion: Sequence[float],
    lens: LensModel,
    bend: tuple[float, float],
    factor: float = 1.0,
    shift: tuple[float, float] = (0.0, 0.0),
) -> tuple[Camera, tuple[float, ...]]:
    """Combine a lens with a correction applied before it: distort rays by OpenCV's k1 and k2
    (``bend``), shift them, and scale all by ``factor``. Return the camera, with scaled focal length
    and the principal point where the axis is seen, and the coefficients.

    There are as many as before, four for a pinhole, fitted to both mappings in turn over the rays
    of the image by least squares (exact for a pinhole). Source: Gauss-Newton.
    """
    v, u = (x.reshape(-1) for x in np.mgrid[: camera.height : 16j, : camera.width : 16j])
    rays = undistorted_rays(np.stack([u, v], 1), camera, distortion, lens) / factor - shift
    square = np.square(rays).sum(1, keepdims=True)
    bent = rays * (1 + bend[0] * square + bend[1] * np.square(square))
    seen = distorted_pixels(factor * (bent + shift), camera, distortion, lens)
    ((cx, cy),) = distorted_pixels(factor * np.array([shift]), camera, distortion, lens).tolist()
    camera = replace(camera, fx=factor * camera.fx, fy=factor * camera.fy, cx=cx, cy=cy)
    found = np.array(distortion or (0.0,) * 4)
    step = 1e-4
    for _ in range(4):  # most coefficients enter linearly
        off = seen - distorted_pixels(rays, camera, tuple(found), lens)
        columns = []
        for change in step * np.eye(len(found)):
            low, high = (
                distorted_pixels(rays, camera, tuple(found + s * change), lens) for s in (-1, 1)
            )
            columns.append((high - low).reshape(-1) / (2 * step))
        found = found + np.linalg.lstsq(np.stack(columns, 1), off.reshape(-1), rcond=1e-9)[0]
    return camera, tuple(found.round(12).tolist())


def _bent(angle: np.ndarray, coefficients: Sequence[float]) -> np.ndarray:
    """Return the radius of an angle in a fisheye image of focal length 1."""
    square = angle**2
    factor = np.zeros_like(angle)
    for k in reversed(coefficients):
        factor = square * (k + factor)
    return angle * (1 + factor)


def _straight(radius: np.ndarray, coefficients: Sequence[float]) -> np.ndarray:
    """Return the angle of a radius in a fisheye image, up to the limit or where the radius falls.

    By bisection, which is safe for any coefficients.
    """
    angles = np.linspace(0.0, FISHEYE_LIMIT, 1000)
    falls = np.flatnonzero(np.diff(_bent(angles, coefficients)) <= 0)
    high = np.full_like(radius, angles[falls[0]] if len(falls) else FISHEYE_LIMIT)
    low = np.zeros_like(radius)
    for _ in range(52):  # to all digits
        middle = (low + high) / 2
        is_below = _bent(middle, coefficients) < radius
        low, high = np.where(is_below, middle, low), np.where(is_below, high, middle)
    return (low + high) / 2
