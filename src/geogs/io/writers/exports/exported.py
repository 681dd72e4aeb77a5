"""Records of all export formats: posed images, and points with the images that see them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8


@dataclass(frozen=True)
class ExportedImage:
    """An image that has been written, with its pose."""

    name: str
    """Name of the file, with its suffix."""
    T_cw: Float64[np.ndarray, "4 4"]
    """World to camera, OpenCV axes."""


@dataclass(frozen=True)
class SeenPoints:
    """Points of the surface and the images that see them."""

    positions: Float64[np.ndarray, "n 3"]
    """In the world."""
    normals: Float32[np.ndarray, "n 3"]
    """In the world, towards the cameras."""
    colours: UInt8[np.ndarray, "n 3"]
    """RGB."""
    seen_point: Int64[np.ndarray, "m"]
    """Point of observation k; ascending."""
    seen_image: Int64[np.ndarray, "m"]
    """Index of the image of observation k."""
    seen_at: Float64[np.ndarray, "m 2"]
    """Column and row of observation k, the centre of the first pixel at (0, 0)."""
