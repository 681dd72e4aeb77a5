"""Visibility of a surface in the cameras of a trajectory, by point or by triangle."""

from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from geogs.errors import InputError
from geogs.evaluation.surfaces.raster import render_mesh
from geogs.evaluation.surfaces.surface import Surface
from geogs.geometry.camera import Camera

CullingRule = Literal["frustum", "occlusion"]

_TOLERANCE = 0.03
"""Largest distance of a seen point behind the occluder's depth, metres."""
_LONG_EDGE = 320
"""Largest longer side of the depth maps, pixels."""


class Visibility:
    """Frustum and occlusion test against depth maps of an occluding mesh.

    A point is seen by a view if it projects into the image in front of the camera and lies at
    most 3 cm behind the occluder's depth there (the rule of Neural RGB-D and GO-Surf). For a
    reconstruction the same rule leaves out parts outside all frusta or hidden behind the true
    surface; parts in observed free space stay, and count as errors.
    """

    def __init__(self, occluder: Surface, camera: Camera, T_cw: Float[np.ndarray, "v 4 4"]) -> None:
        """``T_cw`` are the world-to-camera poses to use, in the occluder's frame."""
        is_large = camera.long_edge > _LONG_EDGE
        self._camera = camera.with_long_edge(_LONG_EDGE) if is_large else camera
        self._T_cw = T_cw
        self._depths = [
            render_mesh(occluder.vertices, occluder.faces, self._camera, T)[0].astype(np.float32)
            for T in T_cw
        ]

    def seen(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
        """Return which points at least one view sees."""
        result = np.zeros(len(points), bool)
        for T, depth in zip(self._T_cw, self._depths, strict=True):
            rest = np.flatnonzero(~result)
            u, v, z = _projected(points[rest], self._camera, T)
            u, v = np.rint(u), np.rint(v)
            height, width = depth.shape
            inside = (z > 1e-6) & (u >= 0) & (v >= 0) & (u < width) & (v < height)
            surface = np.full(len(rest), -np.inf, np.float32)
            surface[inside] = depth[v[inside].astype(int), u[inside].astype(int)]
            result[rest] = z <= surface + _TOLERANCE
        return result


def cull_mesh(
    mesh: Surface,
    camera: Camera,
    T_cw: Float[np.ndarray, "v 4 4"],
    rule: CullingRule,
    occluder: Surface | None = None,
) -> Surface:
    """Keep the triangles that the cameras saw, by one of two common rules.

    ``frustum`` (iMAP, NICE-SLAM) leaves out a triangle if none of its vertices is inside any
    image in front of the camera; hidden ones stay. ``occlusion`` (Neural RGB-D, GO-Surf) also
    requires a vertex at most 3 cm behind the nearest surface in one of the views.

    Args:
        mesh: the mesh to cut, in metres.
        camera: camera of every view.
        T_cw: world to camera of the views, in the frame of the mesh.
        rule: one of the two rules.
        occluder: occluding mesh; the mesh itself if none.

    Raises:
        InputError: nothing is left.
    """
    kept = in_frustum(mesh.vertices, camera, T_cw)[mesh.faces].any(1)
    if rule == "occlusion":
        seen = Visibility(occluder or mesh, camera, T_cw).seen(mesh.vertices)
        kept &= seen[mesh.faces].any(1)
    if not kept.any():
        raise InputError("The cameras see no part of a mesh; are the poses in its frame?")
    return mesh.part(kept)


def in_frustum(
    points: Float[np.ndarray, "n 3"], camera: Camera, T_cw: Float[np.ndarray, "v 4 4"]
) -> Bool[np.ndarray, "n"]:
    """Return which points project into the image of at least one view, in front of it."""
    result = np.zeros(len(points), bool)
    for T in T_cw:
        rest = np.flatnonzero(~result)
        u, v, z = _projected(points[rest], camera, T)
        inside = (u > -0.5) & (u < camera.width - 0.5) & (v > -0.5) & (v < camera.height - 0.5)
        result[rest] = inside & (z > 0)
    return result


def _projected(
    points: Float[np.ndarray, "n 3"], camera: Camera, T_cw: Float[np.ndarray, "4 4"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Pixels and depths of points; pixels are valid only where z > 0."""
    x, y, z = (points @ T_cw[:3, :3].T + T_cw[:3, 3]).T
    safe = np.where(z > 0, z, 1.0)
    return camera.fx * x / safe + camera.cx, camera.fy * y / safe + camera.cy, z
