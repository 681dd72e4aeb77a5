"""Planes through the neighbourhoods of a depth map, and their normals."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float64

from geogs.geometry.camera import Camera

_LEAST_KNOWN = 0.8
"""Least fraction of a neighbourhood with depth."""


@dataclass(frozen=True)
class PlaneFits:
    """The plane around every pixel, as its inverse depth: linear in the pixel's position."""

    value: Float64[np.ndarray, "h w"]
    """Inverse depth at the pixel; 1 where there is no plane."""
    right: Float64[np.ndarray, "h w"]
    """Growth of inverse depth to the next column; 0 where there is no plane."""
    down: Float64[np.ndarray, "h w"]
    """Growth of inverse depth to the next row; 0 where there is no plane."""
    is_known: Bool[np.ndarray, "h w"]
    """Mask: enough of the neighbourhood has depth."""
    is_good: Bool[np.ndarray, "h w"]
    """Mask: the neighbourhood is also planar."""

    def normals(self, camera: Camera) -> Float64[np.ndarray, "h w 3"]:
        """Unit normals in the camera's frame, away from it.

        With n . X = 1 on the plane, 1 / z = n . r on the ray r, so its slopes are n_x / f_x and
        n_y / f_y.
        """
        v, u = np.indices(self.value.shape)
        forward = self.value - self.right * (u - camera.cx) - self.down * (v - camera.cy)
        normal = np.stack([camera.fx * self.right, camera.fy * self.down, forward], -1)
        return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))

    def slant(self, camera: Camera) -> Float64[np.ndarray, "h w"]:
        """Angle between the normal and the pixel's ray, degrees."""
        rays = camera.rays().double().numpy()
        cosine = (self.normals(camera) * rays).sum(-1) / np.linalg.norm(rays, axis=-1)
        return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def fit_planes(depth: Float[np.ndarray, "h w"], side: int, tolerance: float) -> PlaneFits:
    """Fit planes by least squares over ``side`` x ``side`` pixels around each pixel.

    Args:
        depth: z; 0 or infinite where there is none.
        side: of the neighbourhood, odd, pixels.
        tolerance: largest RMS residual of a plane, as a fraction of the depth.
    """
    known = (depth > 0) & np.isfinite(depth)
    weight = known.astype(np.float64)
    w = np.where(known, 1 / np.where(known, depth, 1.0).astype(np.float64), 0.0)
    height, width = depth.shape
    u = np.tile(np.arange(width, dtype=np.float64), (height, 1))
    v = np.tile(np.arange(height, dtype=np.float64)[:, None], (1, width))

    def total(values: np.ndarray) -> np.ndarray:
        border = cv2.BORDER_CONSTANT
        return cv2.boxFilter(values, -1, (side, side), normalize=False, borderType=border)

    n = total(weight)
    safe = np.maximum(n, 1)
    mean_u, mean_v, mean_w = (total(weight * x) / safe for x in (u, v, w))

    def covariance(x: np.ndarray, y: np.ndarray, of_x: np.ndarray, of_y: np.ndarray) -> np.ndarray:
        return total(weight * x * y) / safe - of_x * of_y

    uu, vv = covariance(u, u, mean_u, mean_u), covariance(v, v, mean_v, mean_v)
    uv = covariance(u, v, mean_u, mean_v)
    uw, vw = covariance(u, w, mean_u, mean_w), covariance(v, w, mean_v, mean_w)
    determinant = uu * vv - uv * uv
    enough = known & (n >= _LEAST_KNOWN * side * side) & (determinant > 0.01)
    safe_determinant = np.where(enough, determinant, 1.0)
    right = np.where(enough, (uw * vv - vw * uv) / safe_determinant, 0.0)
    down = np.where(enough, (vw * uu - uw * uv) / safe_determinant, 0.0)
    value = mean_w + right * (u - mean_u) + down * (v - mean_v)
    enough &= value > 0
    rest = covariance(w, w, mean_w, mean_w) - right * uw - down * vw
    good = enough & (rest < (tolerance * value) ** 2)
    return PlaneFits(
        np.where(enough, value, 1.0), np.where(enough, right, 0.0), np.where(enough, down, 0.0),
        enough, good,
    )  # fmt: skip
