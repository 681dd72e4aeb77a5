"""Bare parts of an image, in which nothing can be matched."""

import cv2
import numpy as np
from jaxtyping import Int32, UInt8

EDGE = 320
"""Longest edge of the image that is searched, pixels."""
SMOOTHING = 1.2
"""Standard deviation of the blur that removes noise, pixels of that image."""
MAX_GRADIENT = 2.0
"""Largest gradient, grey levels a pixel, of any channel in a bare part."""
MIN_AREA = 0.003
"""Least area of a segment, as a fraction of the image."""


def bare_segments(image: UInt8[np.ndarray, "ih iw 3"]) -> Int32[np.ndarray, "h w"]:
    """Labels from 1 on of the connected bare parts of an image, 0 elsewhere, at its size or that of
    ``EDGE``, whichever is smaller."""
    height, width = image.shape[:2]
    factor = min(1.0, EDGE / max(height, width))
    size = max(3, round(width * factor)), max(3, round(height * factor))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    smooth = cv2.GaussianBlur(small.astype(np.float32), (0, 0), SMOOTHING)
    change = np.zeros(smooth.shape[:2], np.float32)
    for channel in cv2.split(smooth):
        across = cv2.absdiff(channel[:, 2:], channel[:, :-2])
        down = cv2.absdiff(channel[2:], channel[:-2])
        change[:, 1:-1] = np.maximum(change[:, 1:-1], across)
        change[1:-1] = np.maximum(change[1:-1], down)
    is_bare = (change < 2 * MAX_GRADIENT).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(is_bare, connectivity=4)
    is_large = stats[:, cv2.CC_STAT_AREA] > MIN_AREA * labels.size
    is_large[0] = False
    return (np.cumsum(is_large) * is_large).astype(np.int32)[labels]
