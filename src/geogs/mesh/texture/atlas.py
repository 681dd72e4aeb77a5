"""The image of a textured mesh: patches side by side, their exposures compensated."""

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

from geogs.mesh.texture.atlas_kernels import draw_triangles
from geogs.mesh.texture.packing import scale_that_fits
from geogs.mesh.texture.patches import Patches
from geogs.mesh.triangle_mesh import DepthMapView

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
