"""Packing of the patches' rectangles on shelves of the atlas."""

import math

import numpy as np
from jaxtyping import Int64

from geogs.errors import InputError

STEP = 64
"""Sides of an atlas are multiples of it, pixels."""
_SHRINK = 0.95


def pack(
    sizes: Int64[np.ndarray, "n 2"], limit: int
) -> tuple[Int64[np.ndarray, "n 2"], tuple[int, int]] | None:
    """Left upper corners of rectangles, and width and height of an atlas that holds them all.

    Rectangles stand on shelves, tall ones first. None where they do not fit into ``limit`` pixels
    a side.
    """
    if not len(sizes):
        return np.zeros((0, 2), np.int64), (STEP, STEP)
    area = float(sizes.prod(1).sum())
    width = max(int(sizes[:, 0].max()), math.ceil(1.05 * math.sqrt(area)))
    width = min(_rounded(width), limit)
    if int(sizes[:, 0].max()) > width:
        return None
    places = np.zeros_like(sizes)
    x = y = shelf = 0
    for number in np.lexsort((-sizes[:, 0], -sizes[:, 1])):
        w, h = sizes[number].tolist()
        if x + w > width:
            x, y, shelf = 0, y + shelf, 0
        places[number] = x, y
        x, shelf = x + w, max(shelf, h)
    height = _rounded(y + shelf)
    return (places, (width, height)) if height <= limit else None


def scale_that_fits(
    sizes: Int64[np.ndarray, "n 2"], limit: int, fixed: int
) -> tuple[Int64[np.ndarray, "n 2"], Int64[np.ndarray, "n 2"], tuple[int, int]]:
    """Sizes scaled alike, at most by 1, so that they fit; their positions; the size of the atlas.

    The last ``fixed`` rectangles keep their size.

    Raises:
        InputError: there is no room even for a pixel of each.
    """
    scale = 1.0
    while scale > 1e-3:
        scaled = np.maximum(np.round(sizes * scale), 1).astype(np.int64)
        scaled[len(sizes) - fixed :] = sizes[len(sizes) - fixed :]
        packed = pack(scaled, limit)
        if packed is not None:
            return scaled, *packed
        scale *= _SHRINK
    raise InputError(
        f"A texture of {limit} pixels has no room for the surface; give a larger --texture-size."
    )


def _rounded(length: int) -> int:
    return STEP * math.ceil(max(length, 1) / STEP)
