"""Depth maps of triangle meshes, exact at pixel centres."""

import numpy as np
from jaxtyping import Float, Int

from geogs.geometry.camera import Camera


def render_mesh(
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "m 3"],
    camera: Camera,
    T_cw: Float[np.ndarray, "4 4"],
) -> tuple[Float[np.ndarray, "h w"], Int[np.ndarray, "h w"]]:
    """z of the nearest triangle along each pixel's ray, inf where there is none, and its number.

    ``T_cw`` is world to camera. Both sides of a triangle are seen; a missing one has number -1.
    """
    from geogs.evaluation.surfaces.surface_kernels import rasterise

    depth = np.full((camera.height, camera.width), np.inf)
    face = np.full((camera.height, camera.width), -1, np.int64)
    points = np.ascontiguousarray(vertices @ T_cw[:3, :3].T + T_cw[:3, 3], np.float64)
    rasterise(
        points,
        np.ascontiguousarray(faces, np.int64),
        camera.fx,
        camera.fy,
        camera.cx,
        camera.cy,
        depth,
        face,
    )
    return depth, face
