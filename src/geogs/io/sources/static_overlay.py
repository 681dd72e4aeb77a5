"""Static overlays: image regions that do not change in a video while all else moves.

A time stamp, a logo, a car's bonnet or the arm of a robot suggest that the camera stands still.
Where no mask was given, they are found and masked out.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Shaped, UInt8

IMAGES = 16
"""Number of compared images, spread over a video."""
LEAST_FRAMES = 40
"""Shortest video that is searched, in frames: in about a second a camera hardly moves, and what it
rotates about stands still."""
LEAST_IMAGES = 8
"""Least number of compared images."""
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
CHANGE = 12.0
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
_RIM = 0.12
"""Width of the border that stands still behind a turntable, relative to the image."""
_LEAST_TURNING, _LEAST_SEEN = 0.05, 0.03
"""Least part of the middle that moves, and of the border that has texture."""


def static_overlay(images: Sequence[UInt8[np.ndarray, "h w"]]) -> Bool[np.ndarray, "h w"] | None:
    """Mask of the pixels that stay the same while the camera moves; none if there are none.

    A pixel with a gradient is static where nine of ten images differ from their median by no more
    than a shift of ``_MOTION`` would do. A textureless pixel may look the same wherever the
    camera is, and counts only beside such gradients.

    Args:
        images: grey, upright and of one size, spread over a video.
    """
    if len(images) < LEAST_IMAGES:
        return None
    change, slope, same = _seen(images)
    if (change > CHANGE).mean() < _LEAST_MOVING:
        return None
    found = _parts(same, same & (slope > _TEXTURE))
    return found if found.any() else None


def is_turntable(images: Sequence[UInt8[np.ndarray, "h w"]]) -> bool:
    """Whether only the middle of grey images moves, before a border that has texture and stays."""
    if len(images) < LEAST_IMAGES:
        return False
    change, slope, same = _seen(images)
    rim = np.ones(change.shape, dtype=bool)
    down, right = (round(_RIM * side) for side in change.shape)
    rim[down:-down, right:-right] = False
    textured = rim & (slope > _TEXTURE)
    moves = (change > CHANGE)[~rim].mean() > _LEAST_TURNING
    if not moves or textured.sum() <= _LEAST_SEEN * rim.sum():
        return False
    return bool(same[textured].mean() > _AGREEMENT)


def usual_and_change(
    stack: Shaped[np.ndarray, "n h w *c"], part: float
) -> tuple[Float32[np.ndarray, "h w *c"], Float32[np.ndarray, "h w"]]:
    """Median of grey or coloured images, and the difference from it that ``part`` of them stay
    below, that of the colour which differs most."""
    usual = np.median(stack, axis=0).astype(np.float32)
    changes = np.abs(stack - usual)
    changes = changes.max(-1) if changes.ndim == 4 else changes
    rank = int(part * (len(stack) - 1))
    return usual, np.partition(changes, rank, axis=0)[rank]


def _seen(
    images: Sequence[UInt8[np.ndarray, "h w"]],
) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Difference from the median of smoothed images, gradient per pixel, and where the
    difference is no more than the gradient lets stand still."""
    smooth = np.stack([cv2.GaussianBlur(image, (0, 0), _BLUR) for image in images])
    usual, change = usual_and_change(smooth, _AGREEMENT)
    across, down = (cv2.Sobel(usual, cv2.CV_32F, x, 1 - x, scale=1 / 8) for x in (1, 0))
    slope = np.hypot(across, down)
    return change, slope, change < _MOTION * slope + _NOISE


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
