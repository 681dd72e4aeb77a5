"""Depth of a sensor at the pixels of another image."""

from functools import partial

import cv2
import numpy as np
from jaxtyping import Float32

SAME_SURFACE = 0.03
"""Relative difference of depth up to which neighbouring pixels are interpolated."""


def sampled(
    depth: Float32[np.ndarray, "h w"],
    x: Float32[np.ndarray, "h2 w2"],
    y: Float32[np.ndarray, "h2 w2"],
) -> Float32[np.ndarray, "h2 w2"]:
    """Depth at any columns and rows: interpolated on a surface, the nearest pixel's at its edge.

    Inverse depth is interpolated, which is linear on planes. 0 where unknown.
    """
    known = (depth > 0).astype(np.float32)
    inverse = known / np.where(known > 0, depth, 1)
    at = partial(cv2.remap, map1=x, map2=y, borderMode=cv2.BORDER_CONSTANT, borderValue=0.0)
    linear = at(inverse, interpolation=cv2.INTER_LINEAR)
    fraction = at(known, interpolation=cv2.INTER_LINEAR)
    nearest = at(inverse, interpolation=cv2.INTER_NEAREST)
    smooth = (fraction > 0.999) & (np.abs(linear - nearest) < SAME_SURFACE * nearest)
    chosen = np.where(smooth, linear, nearest)
    return np.where(chosen > 0, 1 / np.where(chosen > 0, chosen, 1), 0).astype(np.float32)
