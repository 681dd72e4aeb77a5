"""Where an image has enough structure to be matched, whatever matches it."""

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from geogs.world.grid import OFFSET, STRIDE

MIN_STRUCTURE = 0.5
"""Smaller eigenvalue of the structure tensor that counts as texture, grey levels^2 / pixel^2."""


def cell_structure(grey: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, "p"]:
    """Smaller eigenvalue at the cells of the sample grid, row by row, grey levels^2 / pixel^2."""
    return smaller_eigenvalue(grey)[OFFSET:-3:STRIDE, OFFSET:-3:STRIDE].reshape(-1)


def grey_levels(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w"]:
    """An RGB image in grey."""
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def textured_fraction(grey: UInt8[np.ndarray, "h w"]) -> float:
    """Fraction of the sample grid on which an image has texture."""
    return float((cell_structure(grey) > MIN_STRUCTURE).mean())


def smaller_eigenvalue(grey: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Smaller eigenvalue of the structure tensor averaged over 9 x 9 pixels, levels^2 / pixel^2."""
    gx = cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=1 / 8)
    gy = cv2.Sobel(grey, cv2.CV_32F, 0, 1, scale=1 / 8)
    xx, yy, xy = (cv2.boxFilter(p, -1, (9, 9)) for p in (gx * gx, gy * gy, gx * gy))
    return (xx + yy) / 2 - np.sqrt(((xx - yy) / 2) ** 2 + xy * xy)
