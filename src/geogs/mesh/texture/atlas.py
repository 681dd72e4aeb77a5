"""The image of a textured mesh: patches side by side, their exposures compensated."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8

from geogs.errors import InputError
from geogs.mesh.colour_kernels import draw_triangles
from geogs.mesh.texture.patches import Patches
from geogs.mesh.triangle_mesh import DepthMapView

STEP = 64
"""Sides of an atlas are multiples of it, pixels."""
SWATCH = 3
"""Side of a square of plain colour, for faces that no view shows, pixels."""


@dataclass(frozen=True, slots=True)
class Atlas:
    """An image and the positions in it of the corners of patches and of the plain colours."""

    image: UInt8[np.ndarray, "h w 3"]
    corner: Float64[np.ndarray, "n 2"]
    """Position of each corner, pixels."""
    swatch: Float64[np.ndarray, "s 2"]
    """Middle of each plain colour, pixels."""


def draw_atlas(
    patches: Patches,
    views: Mapping[int, DepthMapView],
    gains: Float32[np.ndarray, "v 3"],
    corrections: Float32[np.ndarray, "n 3"],
    swatches: UInt8[np.ndarray, "s 3"],
    limit: int,
) -> Atlas:
    """Draw the part of its view that each patch needs, its exposure compensated, into an atlas.

    Args:
        patches: patches of the mesh.
        views: views with the images of the patches.
        gains: factors of the views' colours.
        corrections: offsets of the colours (0 to 255) at the corners.
        swatches: plain colours for the faces that no view shows.
        limit: longest side of the atlas, pixels.

    Raises:
        InputError: the atlas has no room for them.
    """
    across = max(1, int(np.ceil(np.sqrt(len(swatches)))))
    sizes = patches.box[:, 2:] - patches.box[:, :2] + 1
    plain = np.array([[SWATCH * across, SWATCH * across]], np.int64)[: len(swatches)]
    together = np.concatenate([sizes, plain])
    scaled, places, (width, height) = scale_that_fits(together, limit, fixed=len(plain))
    image = np.zeros((height, width, 3), np.uint8)
    factor = scaled[: len(sizes)] / sizes
    own = patches.corner_patch
    local = (patches.pixel - patches.box[own, :2] + 0.5) * factor[own] - 0.5
    for number in range(len(sizes)):
        x, y = places[number]
        w, h = scaled[number]
        drawn = _patch(patches, number, views, gains, corrections, local, (int(w), int(h)))
        image[y : y + h, x : x + w] = drawn
    row, column = np.divmod(np.arange(len(swatches)), across)
    at = places[-1] + SWATCH * np.stack([column, row], -1)
    for (x, y), colour in zip(at.tolist(), swatches, strict=True):
        image[y : y + SWATCH, x : x + SWATCH] = colour
    return Atlas(image, places[own] + local, at + (SWATCH - 1) / 2)


def _patch(
    patches: Patches,
    number: int,
    views: Mapping[int, DepthMapView],
    gains: Float32[np.ndarray, "v 3"],
    corrections: Float32[np.ndarray, "n 3"],
    local: Float64[np.ndarray, "n 2"],
    size: tuple[int, int],
) -> UInt8[np.ndarray, "h w 3"]:
    """Draw the pixels of a patch."""
    view = int(patches.view[number])
    left, top, right, bottom = patches.box[number]
    crop = views[view].rgb()[top : bottom + 1, left : right + 1]
    if (crop.shape[1], crop.shape[0]) != size:
        crop = cv2.resize(crop, size, interpolation=cv2.INTER_AREA)
    corners = patches.corners[patches.start[number] : patches.start[number + 1]]
    drawn = np.zeros((size[1], size[0], 3), np.float32)
    covered = np.zeros((size[1], size[0]), np.float32)
    draw_triangles(local[corners], corrections[corners].astype(np.float64), drawn, covered)
    reach = (9, 9)
    spread = cv2.blur(drawn, reach, borderType=cv2.BORDER_CONSTANT)
    fraction = cv2.blur(covered, reach, borderType=cv2.BORDER_CONSTANT)
    outside = covered == 0
    drawn[outside] = spread[outside] / np.maximum(fraction[outside], 1e-6)[:, None]
    compensated = crop.astype(np.float32) * gains[view] + drawn
    return (compensated + 0.5).clip(0, 255).astype(np.uint8)


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
            x = 0
            y = y + shelf
            shelf = 0
        places[number] = x, y
        x = x + w
        shelf = max(shelf, h)
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
        scale *= 0.95
    raise InputError(
        f"A texture of {limit} pixels has no room for the surface; give a larger --texture-size."
    )


def _rounded(length: int) -> int:
    return STEP * math.ceil(max(length, 1) / STEP)
