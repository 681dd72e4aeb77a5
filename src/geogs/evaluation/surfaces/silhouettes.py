"""Parts of a surface that belong to the object, by its masks in all views."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float

from geogs.evaluation.surfaces.raster import render_mesh
from geogs.evaluation.surfaces.surface import Surface
from geogs.geometry.camera import Camera
from geogs.threads import thread_map

DILATION = 24.0
"""Dilation of the masks, in pixels of an image of FULL_WIDTH."""
FULL_WIDTH = 1600

_BATCH = 200_000


@dataclass(frozen=True)
class Silhouette:
    """Pixels of the object in a view."""

    mask: Bool[np.ndarray, "h w"]
    camera: Camera
    """Camera of an image of the mask's size."""
    T_cw: Float[np.ndarray, "4 4"]
    """World to camera."""

    def dilated(self) -> "Silhouette":
        """Dilate by a disk of 24 pixels of an image 1600 wide, as in DTU's protocol."""
        return replace(self, mask=dilate(self.mask, DILATION * self.camera.width / FULL_WIDTH))


def dilate(mask: Bool[np.ndarray, "h w"], radius: float) -> Bool[np.ndarray, "h w"]:
    """All pixels at most ``radius`` away from a set one."""
    import cv2

    if not mask.any():
        return mask.copy()
    outside = np.where(mask, np.uint8(0), np.uint8(1))
    distance = cv2.distanceTransform(outside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(distance <= radius + 1e-3)


def mesh_silhouettes(
    mesh: Surface, camera: Camera, T_cw: Float[np.ndarray, "v 4 4"]
) -> list[Silhouette]:
    """The silhouettes of a mesh in views (world to camera) of one camera."""

    def silhouette(T: Float[np.ndarray, "4 4"]) -> Silhouette:
        face = render_mesh(mesh.vertices, mesh.faces, camera, T)[1]
        return Silhouette(face >= 0, camera, T)

    return thread_map(silhouette, list(T_cw))


def inside_masks(
    points: Float[np.ndarray, "n 3"], silhouettes: Sequence[Silhouette]
) -> Bool[np.ndarray, "n"]:
    """Points that are on the mask in every view whose image contains them.

    The pixel nearest to the projection decides. Points outside an image, or behind its camera, are
    not tested in it: the rule of 2DGS's culling of DTU meshes.
    """
    parts = np.split(np.ascontiguousarray(points, np.float64), range(_BATCH, len(points), _BATCH))
    return np.concatenate(thread_map(partial(_inside, silhouettes=silhouettes), parts))


def cull_by_masks(mesh: Surface, silhouettes: Sequence[Silhouette]) -> Surface:
    """The triangles whose three vertices are :func:`inside_masks`."""
    return mesh.part(inside_masks(mesh.vertices, silhouettes)[mesh.faces].all(1))


def _inside(
    points: Float[np.ndarray, "n 3"], silhouettes: Sequence[Silhouette]
) -> Bool[np.ndarray, "n"]:
    from geogs.evaluation.surfaces.surface_kernels import keep_inside

    kept = np.ones(len(points), bool)
    for s in silhouettes:
        c = s.camera
        keep_inside(points, s.T_cw, c.fx, c.fy, c.cx, c.cy, s.mask, kept)
    return kept
