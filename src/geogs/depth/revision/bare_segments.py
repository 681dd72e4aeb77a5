"""Bare parts of an image, in which nothing can be matched."""

import cv2
import numpy as np
from jaxtyping import Int32, UInt8

EDGE = 320
"""Longest edge at which they are looked for, pixels."""
SMOOTHING = 1.2
"""Deviation of the blur that takes noise from the image, pixels of that size."""
BARE = 2.0
"""Grey levels a pixel of that size, of the channel that changes most: less is bare."""
LEAST = 0.003
"""Part of the image that one has at least."""


def bare_segments(image: UInt8[np.ndarray, "ih iw 3"]) -> Int32[np.ndarray, "h w"]:
    """Numbers from 1 on of the connected bare parts of an image, 0 elsewhere; at a size of ``EDGE``
    or its own, whichever is smaller."""
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
    is_bare = (change < 2 * BARE).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(is_bare, connectivity=4)
    is_large = stats[:, cv2.CC_STAT_AREA] > LEAST * labels.size
    is_large[0] = False
    return (np.cumsum(is_large) * is_large).astype(np.int32)[labels]
