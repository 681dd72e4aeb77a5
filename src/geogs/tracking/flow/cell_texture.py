"""Texture of an image for matching, along each axis, independent of the flow operator."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from geogs.world.grid import OFFSET, STRIDE

UNINFORMED = 0.01
"""Fraction of the full weight of a match along a direction in which the image does not change:
smoothed flow continues there from the surroundings."""
SHARP = 2.0
"""Structure along a direction above which more does not help, grey levels^2 / pixel^2."""
MIN_STRUCTURE = 0.5
"""Least smaller eigenvalue of the structure tensor of texture, grey levels^2 / pixel^2."""


@dataclass(frozen=True, slots=True)
class CellStructure:
    """Structure tensors of an image at the cells of the sample grid, row by row.

    They are stored as their mean eigenvalue and the rest, grey levels^2 / pixel^2.
    """

    mean: Float[np.ndarray, "p"]
    half: Float[np.ndarray, "p"]
    """Half of xx - yy."""
    radius: Float[np.ndarray, "p"]
    """Distance of the eigenvalues from their mean."""

    @property
    def smaller(self) -> Float[np.ndarray, "p"]:
        """Smaller eigenvalue."""
        return self.mean - self.radius

    @property
    def textured_fraction(self) -> float:
        """Fraction of the cells that have texture."""
        return float((self.smaller > MIN_STRUCTURE).mean())

    @property
    def certainty(self) -> Float[np.ndarray, "p 2"]:
        """Certainty of a match of each cell along x and along y, as a fraction of the full weight.

        A point on an edge is known across the edge, hardly along it. The information of a match is
        that of the structure tensor with each eigenvalue l replaced by min(1, l / SHARP +
        UNINFORMED); its information on one coordinate with the other unknown is the inverse of its
        inverse's diagonal. So a vertical edge counts in x, a horizontal one in y, a slanted one
        little in either.
        """
        eigenvalues = (self.mean + self.radius, self.smaller)
        # For the common tensor of two images they may be negative, which counts as zero.
        across, along = (
            np.clip(value / SHARP, 0, 1 - UNINFORMED) + UNINFORMED for value in eigenvalues
        )
        in_x = 0.5 + 0.5 * self.half / np.maximum(self.radius, 1e-6)  # squared cosine of across
        x, y = along + (across - along) * in_x, across + (along - across) * in_x
        return np.stack([across * along / y, across * along / x], -1)


def cell_structure(grey: UInt8[np.ndarray, "h w"]) -> CellStructure:
    """Compute the structure of an image at the cells of the sample grid."""
    parts = common_tensor(grey, grey)
    return structure_of(*(p[OFFSET:-3:STRIDE, OFFSET:-3:STRIDE].reshape(-1) for p in parts))


def structure_of(
    xx: Float[np.ndarray, "p"], yy: Float[np.ndarray, "p"], xy: Float[np.ndarray, "p"]
) -> CellStructure:
    """Return the structure of cells with these tensors."""
    half = (xx - yy) / 2
    return CellStructure((xx + yy) / 2, half, np.sqrt(half * half + xy * xy))


def common_tensor(
    first: UInt8[np.ndarray, "h w"], second: UInt8[np.ndarray, "h w"], window: int = 9
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Compute the common structure tensor (xx, yy, xy) of two aligned images: products of their
    gradients, averaged over a window of ``window`` pixels a side.

    With itself, an image gives its own structure tensor. Noise adds the squares of its gradients to
    that, but has zero mean for two images, whose noise is independent.
    """
    ax, ay = _gradients(first)
    bx, by = (ax, ay) if second is first else _gradients(second)
    products = ax * bx, ay * by, (ax * by + ay * bx) / 2
    xx, yy, xy = (cv2.boxFilter(p, -1, (window, window)) for p in products)
    return xx, yy, xy


def _gradients(grey: UInt8[np.ndarray, "h w"]) -> list[Float32[np.ndarray, "h w"]]:
    """Return gradients along x and y, grey levels / pixel."""
    return [cv2.Sobel(grey, cv2.CV_32F, *by, scale=1 / 8) for by in ((1, 0), (0, 1))]
