"""Static overlays: what all images of a video show at the same place, while all else moves.

A time stamp, a logo, a car's bonnet or the arm of a robot suggest that the camera stands still.
Where no mask was given, they are found and masked out.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

IMAGES = 16
"""Images that are compared, from all over a video."""
LEAST_FRAMES = 40
"""Shortest video that is searched: in about a second a camera hardly moves, and what it turns about
stands still."""
_LEAST_IMAGES = 8
_AGREEMENT = 0.9
"""Part of the images in which a place has to look the same: of a glitch nothing follows."""
_BLUR = 1.0
"""Pixels, against noise and the blocks of a codec."""
_TEXTURE = 4.0
"""Grey levels a pixel from which on a gradient would show that something moves."""
_MOTION = 0.15
"""Pixels that what stands still may seem to move."""
_NOISE = 1.5
"""Grey levels that it may change by besides."""
_CHANGE = 12.0
"""Grey levels by which a pixel changes that plainly shows other things in other images."""
_LEAST_MOVING = 0.4
"""Part of the pixels that have to: else the camera rests or hardly moves, and what is far away
stands still as well."""
_GAP = 0.02
"""Distance between still gradients up to which all between them is still, of the longer side."""
_DENSE = 0.08
"""Part of the pixels around that have a still gradient, where one counts."""
_LEAST_AREA, _LEAST_GRADIENTS = 0.002, 0.001
"""Least area of a static part and of its gradients, as fractions of the image."""
_LEAST_RATIO = 0.05
"""Part of the pixels of what looks the same in all images that still gradients have to be: a sky
does, too, wherever the camera is."""


def static_overlay(images: Sequence[UInt8[np.ndarray, "h w"]]) -> Bool[np.ndarray, "h w"] | None:
    """Mask of what all images show at the same place while the camera moves; none if nothing.

    A pixel with a gradient is static where nine of ten images differ from their median by no more
    than a shift of ``_MOTION`` would do. A bare pixel may look the same wherever the camera is, and
    counts only beside such gradients.

    Args:
        images: grey, upright and of one size, from all over a video.
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
    """Length of the gradient, a pixel."""
    across, down = (cv2.Sobel(image, cv2.CV_32F, x, 1 - x, scale=1 / 8) for x in (1, 0))
    return np.hypot(across, down)


def _parts(
    same: Bool[np.ndarray, "h w"], still: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """The parts of an image with many still gradients, without gaps and without specks; what looks
    the same beside these belongs to them, but where it has hardly any of its own."""
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
