"""Kinds of region in a view, by its true depth and its image alone: edges, thin things, bare walls.

A jump of depth is given as a fraction of the farther depth: 1 - near / far.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float64, UInt8

from geogs.geometry.camera import Camera
from geogs_bench.results.record import Place
from geogs_bench.scoring.plane_fits import PlaneFits

JUMP = 0.05
"""Least jump of depth of an edge, and between a thin thing and its background."""
NEAR_EDGE = 5
"""Pixels to either side of a jump that belong to the edge."""
THIN, LONG = 13, 20
"""Side of the square that does not fit into a thin thing, and its least length, pixels."""
BEHIND = 20
"""Pixels around a thin thing in which farther pixels count as behind it."""
BARE = 1.0
"""Largest gradient of a bare region: grey levels a pixel, root mean square over 9 x 9 pixels of the
smoothed image. Plain walls of photographs have 0.3 to 0.9, from shading and residual noise."""
GRAZING = 75.0
"""Least angle between the normal and the ray of a grazing view, degrees."""
_LONGEST_GAP = 32
"""Most pixels without depth across which a jump is detected: a sensor's shadow at an edge."""
_SMOOTHING = 2.0
"""Standard deviation of the blur that removes noise and JPEG's blocks, pixels."""
_PATCH = 9


def places_of(
    depth: Float[np.ndarray, "h w"],
    image: UInt8[np.ndarray, "h w 3"],
    camera: Camera,
    fits: PlaneFits,
) -> dict[Place, Bool[np.ndarray, "h w"]]:
    """Masks of the pixels of each kind.

    Args:
        depth: true z; 0 where it is unknown, infinite in the sky.
        image: RGB.
        camera: of both.
        fits: planes of ``depth``.
    """
    inverse = inverse_depth(depth)
    known = inverse > 0
    thin = thin_things(inverse)
    special: dict[Place, np.ndarray] = {
        "edge": _widened(edges(inverse), NEAR_EDGE - 1),
        "thin": thin,
        "behind thin": _behind(inverse, thin),
        "bare": bare(image),
        "grazing": fits.is_good & (fits.slant(camera) > GRAZING),
    }
    special = {name: known & mask for name, mask in special.items()}
    plain = known & ~np.logical_or.reduce([*special.values()])
    return {"all": known, "open": plain, **special, "sky": inverse == 0}


def inverse_depth(depth: Float[np.ndarray, "h w"]) -> Float64[np.ndarray, "h w"]:
    """1 / z; 0 in the sky, NaN where it is unknown."""
    with np.errstate(divide="ignore"):
        return np.where(depth > 0, 1 / depth.astype(np.float64), np.nan)


def edges(inverse: Float64[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Mask of the pixels at either end of a jump, along a row or column, that no plane explains."""
    found = np.zeros(inverse.shape, bool)
    for line, marks in (*zip(inverse, found, strict=True), *zip(inverse.T, found.T, strict=True)):
        _mark_jumps(line, marks)
    return found


def _mark_jumps(line: Float64[np.ndarray, "n"], marks: Bool[np.ndarray, "n"]) -> None:
    """Mark neighbours of one line whose step fits the slope neither before nor after it.

    Inverse depth is linear along a plane, so the slope on either side predicts the plane's step.
    """
    at = np.flatnonzero(~np.isnan(line))
    if len(at) < 2:
        return
    gap, step = np.diff(at), np.diff(line[at])
    slope = step / gap
    left = np.abs(step - np.append(np.inf, slope[:-1]) * gap)
    right = np.abs(step - np.append(slope[1:], np.inf) * gap)
    unexplained = np.minimum(np.minimum(left, right), np.abs(step))
    nearest = np.maximum(line[at[:-1]], line[at[1:]])
    jump = (unexplained > JUMP * nearest) & (gap <= _LONGEST_GAP)
    marks[at[:-1][jump]] = True
    marks[at[1:][jump]] = True


def thin_things(inverse: Float64[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Mask of the long regions that an opening of the inverse depth removes.

    Surfaces are assumed to continue beyond the border and where the depth is unknown.
    """
    square, half = np.ones((THIN, THIN), np.uint8), THIN // 2
    unknown = np.isnan(inverse)
    padded = np.pad(np.where(unknown, np.inf, inverse), half, constant_values=np.inf)
    opened = cv2.dilate(cv2.erode(padded, square), square)[half:-half, half:-half]
    narrow = ~unknown & (np.nan_to_num(inverse) * (1 - JUMP) > opened)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(narrow.astype(np.uint8))
    length = np.maximum(stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT])
    is_long = length >= LONG
    is_long[0] = False  # the background
    return np.asarray(is_long[labels])


def _behind(
    inverse: Float64[np.ndarray, "h w"], thin: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Mask of the pixels that are farther than a thin thing nearby."""
    side = 2 * BEHIND + 1
    nearest = cv2.dilate(np.where(thin, inverse, 0.0), np.ones((side, side), np.uint8))
    return np.asarray(~thin & (inverse < (1 - JUMP) * nearest))


def bare(image: UInt8[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
    """Mask of the pixels around which the image hardly changes."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float64)
    smooth = cv2.GaussianBlur(grey, (0, 0), _SMOOTHING)
    down, across = np.gradient(smooth)
    energy = cv2.boxFilter(across**2 + down**2, -1, (_PATCH, _PATCH))
    return np.asarray(energy < BARE**2)


def _widened(mask: Bool[np.ndarray, "h w"], pixels: int) -> Bool[np.ndarray, "h w"]:
    """The mask, dilated by ``pixels`` along rows and columns."""
    side = 2 * pixels + 1
    return cv2.dilate(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
