"""A textured mesh as a camera sees it, to compare with an image."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from geogs.evaluation.surfaces.raster import render_mesh
from geogs.geometry.camera import Camera


def render_textured(
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "m 3"],
    uv: Float[np.ndarray, "n 2"],
    texture: UInt8[np.ndarray, "h w 3"],
    camera: Camera,
    T_cw: Float[np.ndarray, "4 4"],
) -> tuple[UInt8[np.ndarray, "ih iw 3"], Bool[np.ndarray, "ih iw"]]:
    """The image, black where there is no surface, and where there is one.

    ``uv`` is in pixels of the texture; ``T_cw`` is world to camera.
    """
    depth, face = render_mesh(vertices, faces, camera, T_cw)
    hit = face >= 0
    rays = camera.rays().numpy().astype(np.float64)[hit]
    points = rays * depth[hit][:, None]
    corners = (vertices.astype(np.float64) @ T_cw[:3, :3].T + T_cw[:3, 3])[faces[face[hit]]]
    weights = np.linalg.solve(corners.transpose(0, 2, 1), points[..., None])[..., 0]
    place = (weights[..., None] * uv[faces[face[hit]]]).sum(1)
    image = np.zeros((camera.height, camera.width, 3), np.uint8)
    u, v = np.zeros(hit.shape, np.float32), np.zeros(hit.shape, np.float32)
    u[hit], v[hit] = place.T
    drawn = cv2.remap(texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    image[hit] = drawn[hit]
    return image, hit


def psnr(
    image: UInt8[np.ndarray, "h w 3"],
    truth: UInt8[np.ndarray, "h w 3"],
    where: Bool[np.ndarray, "h w"],
) -> float:
    """Peak signal-to-noise ratio in decibels over some pixels; NaN where there are none."""
    if not where.any():
        return float("nan")
    error = image[where].astype(np.float64) - truth[where]
    return float(10 * np.log10(255.0**2 / max(float((error**2).mean()), 1e-9)))
