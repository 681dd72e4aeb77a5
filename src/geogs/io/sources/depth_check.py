"""Measured depth against given poses: parallax tells by how much their scales differ."""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

from geogs.geometry.camera import Camera

STEPS = (1, 4, 12)
"""Images between the two of a pair."""
ANCHORS = 8
"""Number of images, spread over the recording, with which pairs begin."""
CORNERS = 400
"""Most corners that are followed from an image."""
LEAST_PARALLAX = 3.0
"""Least motion of a corner by the camera's translation, pixels."""
LARGEST_RESIDUAL = 1.5
"""Largest distance of a corner from where the poses let it be at any depth, pixels."""
LEAST_MATCHES = 60
"""Fewest corners that tell a ratio."""
LARGEST_SPREAD = 0.25
"""Largest median deviation of the logarithm of the corners' ratios from its median."""


@dataclass(frozen=True)
class MeasuredView:
    """An image with its depth and pose."""

    grey: UInt8[np.ndarray, "h w"]
    metres: Float32[np.ndarray, "h w"]
    """Depth; 0 where unknown."""
    T_cw: Float64[np.ndarray, "4 4"]
    """World to camera."""


def ratio_to_depth(
    pairs: Iterable[tuple[MeasuredView, MeasuredView]], camera: Camera
) -> float | None:
    """Depths by the parallax of given poses, divided by measured ones; None if few corners tell."""
    found = [_ratios(one, two, camera) for one, two in pairs]
    ratios = np.log(np.concatenate([np.zeros(0), *found]))
    if len(ratios) < LEAST_MATCHES:
        return None
    middle = np.median(ratios)
    spread = np.median(np.abs(ratios - middle))
    return float(np.exp(middle)) if spread <= LARGEST_SPREAD else None


def _ratios(one: MeasuredView, two: MeasuredView, camera: Camera) -> Float64[np.ndarray, "n"]:
    """Ratios of single corners of the first image, where they have depth."""
    first, second = _followed(one, two)
    columns, rows = np.rint(first).astype(int).T
    measured = one.metres[rows, columns].astype(np.float64)
    T = two.T_cw @ np.linalg.inv(one.T_cw)
    turned = _rays(first, camera) @ T[:3, :3].T
    seen = _rays(second, camera)[:, :2]
    # A corner at depth z is seen at (z turned + t), divided by its third component.
    slope = turned[:, :2] - seen * turned[:, 2:]
    offset = seen * T[2, 3] - T[:2, 3]
    depth = (slope * offset).sum(1) / np.maximum((slope * slope).sum(1), 1e-12)
    at = depth[:, None] * turned + T[:3, 3]
    behind = (depth <= 0) | (at[:, 2] <= 0) | (turned[:, 2] <= 0)
    at[behind], turned[behind] = 1.0, 1.0
    residual = np.linalg.norm(at[:, :2] / at[:, 2:] - seen, axis=1) * camera.fx
    parallax = np.linalg.norm(turned[:, :2] / turned[:, 2:] - seen, axis=1) * camera.fx
    tells = ~behind & (measured > 0) & (residual < LARGEST_RESIDUAL) & (parallax > LEAST_PARALLAX)
    return depth[tells] / measured[tells]


def _followed(
    one: MeasuredView, two: MeasuredView
) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, "n 2"]]:
    """Corners of the first image and where the second shows them."""
    corners = cv2.goodFeaturesToTrack(one.grey, CORNERS, 0.01, 5)
    if corners is None:
        return np.zeros((0, 2)), np.zeros((0, 2))
    there, found, _ = cv2.calcOpticalFlowPyrLK(one.grey, two.grey, corners, corners.copy())
    back, returned, _ = cv2.calcOpticalFlowPyrLK(two.grey, one.grey, there, corners.copy())
    returns = np.linalg.norm((back - corners).reshape(-1, 2), axis=1) < 0.5
    kept = returns & (found.ravel() > 0) & (returned.ravel() > 0)
    first, second = (p.reshape(-1, 2)[kept].astype(np.float64) for p in (corners, there))
    return first, second


def _rays(pixels: Float64[np.ndarray, "n 2"], camera: Camera) -> Float64[np.ndarray, "n 3"]:
    x = (pixels[:, 0] - camera.cx) / camera.fx
    y = (pixels[:, 1] - camera.cy) / camera.fy
    return np.stack([x, y, np.ones_like(x)], axis=1)
