"""Completion of the tracker's sparse, unevenly certain inverse depth on its own grid."""

import functools
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from scipy.linalg import solveh_banded

from geogs.geometry.camera import Camera
from geogs.world.grid import OFFSET, STRIDE

DEVIATION_SCALE = 0.14
"""Ratio of real to expected deviation of the tracker's inverse depth, from rendered rooms."""
BENDING = 0.02
"""Typical second difference of inverse depth per cell, relative to its median."""
MEMBRANE = 0.3
"""Typical first difference per cell, relative to the median: large for slanted surfaces."""
EDGE_SHARPNESS = 48.0
"""Rate k of smoothness exp(-k g) by the image gradient g (Lab, 0 to 1 per pixel)."""


@dataclass(frozen=True)
class CompletedDepth:
    """Smooth inverse depth on the tracker's grid, and the tracker's certainty."""

    inverse_depth: Float32[np.ndarray, "gh gw"]
    """Inverse depth, per map unit."""
    deviation: Float32[np.ndarray, "gh gw"]
    """Relative standard deviation z / sqrt(information) that the bundle adjustment expects."""
    inlier: Bool[np.ndarray, "gh gw"]
    """Cells whose value of the tracker survived the robust fit."""


def complete_inverse_depth(
    inverse_depth: Float32[np.ndarray, "gh gw"],
    information: Float32[np.ndarray, "gh gw"],
    image: UInt8[np.ndarray, "h w 3"],
) -> CompletedDepth:
    """Fit a smooth surface to the tracker's inverse depth, weighted by its information.

    Minimises sum rho((x - d) / s) + sum w (second differences)^2 + a weak sum w (differences)^2,
    by reweighted least squares with the Cauchy weight (it is linear, so each round solves it
    directly, without the general least-squares loop); w falls at image edges. s is the deviation
    of inverse depth, ``DEVIATION_SCALE`` / sqrt(information), plus 0.2 % of d. Cells without a
    finite positive value or without information are filled from around them.
    """
    smooth = edge_weights(image, inverse_depth.shape)
    return complete_grid(inverse_depth, information, smooth)


def complete_grid(
    inverse_depth: Float32[np.ndarray, "gh gw"],
    information: Float32[np.ndarray, "gh gw"],
    smooth: Float32[np.ndarray, "gh gw"],
) -> CompletedDepth:
    """``complete_inverse_depth`` with given weights of smoothness, such as ``edge_weights``."""
    known = known_cells(inverse_depth, information)
    if not known.any():
        one = np.ones_like(inverse_depth)
        return CompletedDepth(one, np.full_like(one, 1e3), np.zeros(one.shape, bool))
    typical = float(np.median(inverse_depth[known]))
    data = np.where(known, inverse_depth, typical).astype(np.float64)
    amount = np.where(known, information, 0.0).astype(np.float64)
    deviation = 1.0 / (data * np.sqrt(amount) + 1e-3)
    scale = DEVIATION_SCALE / np.sqrt(amount + 1e-9) + 0.002 * data
    smoothness = _smoothness_bands(smooth, typical)
    weight = np.ones_like(data)
    for _ in range(4):
        precision = weight / scale**2
        bands = smoothness.copy()
        bands[0] += precision.T.ravel() + 1e-6 / typical**2
        x = solveh_banded(bands, (precision * data).T.ravel(), lower=True, check_finite=False)
        fitted = x.reshape(data.shape[::-1]).T
        weight = 1.0 / (1.0 + ((fitted - data) / (2.0 * scale)) ** 2)
    fitted = np.clip(fitted, 0.12 * typical, 7.0 * typical)
    inlier = known & (weight > 0.3)
    return CompletedDepth(fitted.astype(np.float32), deviation.astype(np.float32), inlier)


def known_cells(
    inverse_depth: Float32[np.ndarray, "gh gw"], information: Float32[np.ndarray, "gh gw"]
) -> Bool[np.ndarray, "gh gw"]:
    """Whether the tracker has a depth of each cell."""
    known = np.isfinite(inverse_depth) & (inverse_depth > 1e-6)
    return known & np.isfinite(information) & (information > 0)


def edge_weights(
    image: UInt8[np.ndarray, "h w 3"], shape: tuple[int, ...]
) -> Float32[np.ndarray, "gh gw"]:
    """exp(-sharpness |gradient of the Lab image|), the strongest within three pixels of a cell."""
    sharp = cv2.cvtColor(image, cv2.COLOR_RGB2LAB).astype(np.float32) * np.float32(1 / 255)
    lab = cv2.GaussianBlur(sharp, (0, 0), 1.5)
    # Channel by channel: over the last axis NumPy takes many times as long.
    slopes = (cv2.Sobel(c, -1, x, 1 - x, scale=1 / 8) for c in cv2.split(lab) for x in (1, 0))
    strongest = functools.reduce(cv2.max, map(np.abs, slopes))
    edge = cv2.dilate(strongest, np.ones((7, 7), np.uint8))
    rows = np.minimum(OFFSET + STRIDE * np.arange(shape[0]), edge.shape[0] - 1)
    columns = np.minimum(OFFSET + STRIDE * np.arange(shape[1]), edge.shape[1] - 1)
    return np.exp(-EDGE_SHARPNESS * edge[np.ix_(rows, columns)])


def _smoothness_bands(weight: Float32[np.ndarray, "gh gw"], typical: float) -> np.ndarray:
    """Lower bands, for ``solveh_banded``, of the smoothness term's normal matrix.

    Unknowns run down the columns of the grid (index = column * gh + row), which keeps the band
    2 gh wide.
    """
    w = weight.astype(np.float64).T
    gw, gh = w.shape
    bands = np.zeros((2 * gh + 1, gw, gh))
    bend = 1.0 / (BENDING * typical)
    stretch = 1.0 / (MEMBRANE * typical)
    for axis, step in ((0, gh), (1, 1)):
        v = np.moveaxis(w, axis, 0)
        terms: list[tuple[tuple[float, ...], np.ndarray]] = [
            ((1.0, -2.0, 1.0), (bend * v[1:-1]) ** 2),
            ((1.0, -1.0), (stretch * np.minimum(v[:-1], v[1:])) ** 2),
        ]
        for coefficients, square in terms:
            for i, left in enumerate(coefficients):
                for j in range(i, len(coefficients)):
                    band = np.moveaxis(bands[(j - i) * step], axis, 0)
                    band[i : i + len(square)] += left * coefficients[j] * square
    return bands.reshape(2 * gh + 1, gw * gh)


def upsample_grid(
    grid: Float32[np.ndarray, "gh gw"], working: Camera, render: Camera
) -> Float32[np.ndarray, "h w"]:
    """Bilinear values of a tracker grid at the pixels of the render camera; borders repeat."""
    u = (np.arange(render.width) - render.cx) * (working.fx / render.fx) + working.cx
    v = (np.arange(render.height) - render.cy) * (working.fy / render.fy) + working.cy
    columns = ((u - OFFSET) / STRIDE).astype(np.float32)
    rows = ((v - OFFSET) / STRIDE).astype(np.float32)
    x, y = np.meshgrid(columns, rows)
    values = np.ascontiguousarray(grid, np.float32)
    return cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
