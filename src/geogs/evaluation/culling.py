"""Meshes cut down to what cameras saw of them, triangle by triangle.

For the protocols whose errors rest on whole meshes; evaluation.visibility does it for samples.
"""

from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from geogs.errors import InputError
from geogs.evaluation.surface import Surface
from geogs.evaluation.visibility import Visibility
from geogs.geometry.camera import Camera

CullingRule = Literal["frustum", "occlusion"]


def cull_mesh(
    mesh: Surface,
    camera: Camera,
    T_cw: Float[np.ndarray, "v 4 4"],
    rule: CullingRule,
    occluder: Surface | None = None,
) -> Surface:
    """The triangles that the cameras saw by one of two customary rules.

    ``frustum`` (iMAP, NICE-SLAM) leaves out a triangle if none of its vertices is inside any
    image in front of the camera; hidden ones stay. ``occlusion`` (Neural RGB-D, GO-Surf) asks
    besides that a vertex be at most 3 cm behind the nearest surface in one of the views.

    Args:
        mesh: what to cut, in metres.
        camera: of every view.
        T_cw: world to camera of the views, in the frame of the mesh.
        rule: which of the two.
        occluder: what hides parts of the mesh; the mesh itself if none.

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
    """Which points at least one view has inside its image, in front of it."""
    result = np.zeros(len(points), bool)
    for T in T_cw:
        rest = np.flatnonzero(~result)
        x, y, z = (points[rest] @ T[:3, :3].T + T[:3, 3]).T
        safe = np.where(z > 0, z, 1.0)
        u, v = camera.fx * x / safe + camera.cx, camera.fy * y / safe + camera.cy
        inside = (u > -0.5) & (u < camera.width - 0.5) & (v > -0.5) & (v < camera.height - 0.5)
        result[rest] = inside & (z > 0)
    return result
