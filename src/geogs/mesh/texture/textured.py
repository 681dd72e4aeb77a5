"""Texturing of a mesh from the images of its views."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int32, UInt8

from geogs.errors import InputError
from geogs.mesh.texture.atlas import Atlas, draw_atlas
from geogs.mesh.texture.candidates import find_candidates
from geogs.mesh.texture.exposure import seam_corrections, view_gains
from geogs.mesh.texture.labels import choose_views, face_neighbours, without_colour_outliers
from geogs.mesh.texture.patches import Patches, cut_patches
from geogs.mesh.triangle_mesh import DepthMapView, Mesh

_GREY = 128
_COLOUR_STEP = 8
"""Plain colours of faces that no view shows are rounded to this, so that many share one."""


@dataclass(frozen=True, slots=True)
class TexturedMesh:
    """Triangles in the world frame with a texture; vertices on seams are repeated."""

    vertices: Float[np.ndarray, "n 3"]
    """float32, map units."""
    faces: Int32[np.ndarray, "m 3"]
    """Vertices of each face, in the order of the original mesh."""
    normals: Float[np.ndarray, "n 3"]
    uv: Float[np.ndarray, "n 2"]
    """Positions in the texture, pixels with centres at integers."""
    texture: UInt8[np.ndarray, "h w 3"]
    """RGB."""
    seen: float
    """Fraction of the faces that an image shows; the others have a plain colour."""


def texture_mesh(
    mesh: Mesh, views: Sequence[DepthMapView], tolerance: float, limit: int = 4096
) -> TexturedMesh:
    """Give a mesh a texture, composed of the images of the views.

    Each face gets the view that shows it largest and sharpest, with a preference for that of its
    neighbours; the views' exposures are compensated, and remaining differences at seams are spread
    over the patches.

    Args:
        mesh: the mesh; faces that no view shows take its colours, grey if it has none.
        views: depth maps with images; each is read once or twice.
        tolerance: largest distance of a face from a depth map that shows it, map units.
        limit: longest side of the image, pixels.

    Raises:
        InputError: there is no face, no image, or no room.
    """
    if not len(mesh.faces):
        raise InputError("There is no mesh to give a texture to.")
    candidates = find_candidates(mesh, views, tolerance)
    if not (candidates.view >= 0).any():
        raise InputError("No image shows any of the mesh, so there is no texture for it.")
    gains = view_gains(candidates, len(views))
    neighbours = face_neighbours(mesh.faces)
    score = without_colour_outliers(candidates, gains)
    label = choose_views(candidates, score, neighbours)
    images = {int(v): views[int(v)] for v in np.unique(label[label >= 0])}
    patches = cut_patches(mesh, images, label, neighbours)
    colour = _corner_colours(patches, images, gains)
    corrections = seam_corrections(patches.corner_vertex, patches.edges(), colour)
    plain, swatches, swatch_of = _plain_colours(mesh, label)
    atlas = draw_atlas(patches, images, gains, corrections, swatches, limit)
    return _assembled(mesh, patches, plain, swatch_of, atlas)


def _corner_colours(
    patches: Patches, views: Mapping[int, DepthMapView], gains: np.ndarray
) -> np.ndarray:
    """Colour of each corner in its view, after the gain, 0 to 255."""
    import cv2

    colour = np.zeros((len(patches.pixel), 3), np.float32)
    own = patches.view[patches.corner_patch]
    for v in np.unique(patches.view):
        here = np.flatnonzero(own == v)
        image = views[int(v)].rgb()
        smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
        x, y = np.round(patches.pixel[here]).astype(int).T
        x, y = x.clip(0, image.shape[1] - 1), y.clip(0, image.shape[0] - 1)
        colour[here] = smooth[y, x] * gains[v]
    return colour


def _plain_colours(
    mesh: Mesh, label: Int32[np.ndarray, "m"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The faces that no view shows, their different colours, and the index of each face's."""
    faces = np.flatnonzero(label < 0)
    if mesh.colours is None:
        colour = np.full((len(faces), 3), _GREY)
    else:
        colour = mesh.colours[mesh.faces[faces]].mean(1)
    colour = (np.round(colour / _COLOUR_STEP) * _COLOUR_STEP).clip(0, 255).astype(np.uint8)
    swatches, which = np.unique(colour, axis=0, return_inverse=True)
    return faces, swatches.reshape(-1, 3), which.reshape(-1)


def _assembled(
    mesh: Mesh, patches: Patches, plain: np.ndarray, swatch_of: np.ndarray, atlas: Atlas
) -> TexturedMesh:
    """Corners of the patches, then those of the plain faces, which share none."""
    count = len(patches.corner_vertex)
    faces = np.empty((len(mesh.faces), 3), np.int32)
    faces[patches.faces] = patches.corners
    faces[plain] = count + np.arange(3 * len(plain)).reshape(-1, 3)
    vertex = np.concatenate([patches.corner_vertex, mesh.faces[plain].ravel()])
    uv = np.concatenate([atlas.corner, np.repeat(atlas.swatch[swatch_of], 3, axis=0)])
    seen = len(patches.faces) / len(mesh.faces)
    return TexturedMesh(
        mesh.vertices[vertex], faces, mesh.normals[vertex], uv.astype(np.float32), atlas.image, seen
    )
