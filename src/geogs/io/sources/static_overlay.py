"""Static overlays: image regions that do not change in a video while all else moves.

A time stamp, a logo, a car's bonnet or the arm of a robot suggest that the camera stands still.
Where no mask was given, they are found and masked out.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

IMAGES = 16
"""Number of compared images, spread over a video."""
LEAST_FRAMES = 40
"""Shortest video that is searched, in frames: in about a second a camera hardly moves, and what it
rotates about stands still."""
_LEAST_IMAGES = 8
_AGREEMENT = 0.9
"""Fraction of images in which a pixel must look the same, so that a glitch has no effect."""
_BLUR = 1.0
"""Standard deviation of the blur in pixels, against noise and codec blocks."""
_TEXTURE = 4.0
"""Least gradient, in grey levels a pixel, that would show a motion."""
_MOTION = 0.15
"""Largest apparent motion of a static pixel, in pixels."""
_NOISE = 1.5
"""Largest additional change of a static pixel, in grey levels."""
_CHANGE = 12.0
"""Change of a pixel, in grey levels, that shows that its content moves."""
_LEAST_MOVING = 0.4
"""Least fraction of such pixels: with fewer the camera rests or hardly moves, and distant points
stand still as well."""
_GAP = 0.02
"""Largest gap between still gradients that is filled, relative to the longer side."""
_DENSE = 0.08
"""Least fraction of neighbours with a still gradient, for a still gradient to count."""
_LEAST_AREA, _LEAST_GRADIENTS = 0.002, 0.001
"""Least area of a static part and of its gradients, as fractions of the image."""
_LEAST_RATIO = 0.05
"""Least fraction of still gradients in an unchanged region: a sky looks the same, too, wherever the
camera is."""


def static_overlay(images: Sequence[UInt8[np.ndarray, "h w"]]) -> Bool[np.ndarray, "h w"] | None:
    """Mask of the pixels that stay the same while the camera moves; none if there are none.

    A pixel with a gradient is static where nine of ten images differ from their median by no more
    than a shift of ``_MOTION`` would do. A textureless pixel may look the same wherever the
    camera is, and counts only beside such gradients.

    Args:
        images: grey, upright and of one size, spread over a video.
    """
    if len(images) < _LEAST_IMAGES:
        return None
    smooth = np.stack([cv2.GaussianBlur(image, (0, 0), _BLUR) for image in images])
    usual = np.median(smooth, axis=0).astype(np.float32)
    changes = np.abs(smooth - usual)
    rank = int(_AGREEMENT * (len(images) - 1))
    change = np.partition(changes, rank, axis=0)[rank]
    if (change > _CHANGE).mean() < _LEAST_MOVING:
        return None
    slope = _slope(usual)
    same = change < _MOTION * slope + _NOISE
    found = _parts(same, same & (slope > _TEXTURE))
    return found if found.any() else None


def _slope(image: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Length of the gradient per pixel."""
    across, down = (cv2.Sobel(image, cv2.CV_32F, x, 1 - x, scale=1 / 8) for x in (1, 0))
    return np.hypot(across, down)


def _parts(
    same: Bool[np.ndarray, "h w"], still: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Regions of an image with many still gradients, without gaps and specks, and unchanged regions
    that have at least some still gradients."""
    reach = max(2, round(_GAP * max(still.shape)))
    side = (2 * reach + 1, 2 * reach + 1)
    around = cv2.boxFilter(still.astype(np.float32), -1, side, borderType=cv2.BORDER_REFLECT)
    still = still & (around > _DENSE)
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, side)
    found = np.zeros_like(still)
    for seen, least in ((still, 0.0), (same, _LEAST_RATIO)):
        closed = cv2.morphologyEx(seen.astype(np.uint8), cv2.MORPH_CLOSE, disk)
        count, part = cv2.connectedComponents(closed)
        area = np.bincount(part.ravel(), minlength=count)
        gradients = np.bincount(part[still], minlength=count)
        kept = (area > _LEAST_AREA * still.size) & (gradients > least * area)
        kept &= gradients > _LEAST_GRADIENTS * still.size
        found |= kept[part] & (closed > 0)
    return found
