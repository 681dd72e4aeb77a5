"""Texturing of a mesh from the images of its views, their exposures compensated."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import scipy.sparse as sparse
from jaxtyping import Float, Float32, Float64, Int, Int32, Int64, UInt8
from scipy.sparse.linalg import cg, spsolve

from geogs.errors import InputError
from geogs.mesh.colour import GREY
from geogs.mesh.texture.atlas import Atlas, draw_atlas
from geogs.mesh.texture.face_views import (
    Candidates,
    choose_views,
    face_neighbours,
    find_candidates,
    sampled,
    without_colour_outliers,
)
from geogs.mesh.texture.patches import Patches, cut_patches
from geogs.mesh.triangle_mesh import DepthMapView, Mesh

_COLOUR_STEP = 8
"""Plain colours of faces that no view shows are rounded to this, so that many share one."""
MAX_GAIN = 2.0
"""Largest factor by which a view is made brighter or darker."""
_DARK, _BRIGHT = 10.0, 245.0
_PRIOR, _ROUNDS, _HUBER = 0.02, 5, 0.05
_STIFFNESS = 0.1
"""Weight of equal corrections at both ends of an edge; that of equal colours at seams is 1."""


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
    images = {int(v): _image_alone(views[int(v)]) for v in np.unique(label[label >= 0])}
    patches = cut_patches(mesh, images, label, neighbours)
    colour = _corner_colours(patches, images, gains)
    corrections = seam_corrections(patches.corner_vertex, patches.edges(), colour)
    plain, swatches, swatch_of = _plain_colours(mesh, label)
    atlas = draw_atlas(patches, images, gains, corrections, swatches, limit)
    return _assembled(mesh, patches, plain, swatch_of, atlas)


def _image_alone(view: DepthMapView) -> DepthMapView:
    """The view without its depth map, which would fill the memory."""
    depth, weight = (values[:1, :1].clone() for values in (view.depth, view.weight))
    return replace(view, depth=depth, weight=weight)


def view_gains(candidates: Candidates, views: int) -> Float32[np.ndarray, "v 3"]:
    """Factors for red, green and blue of each view after which they show faces alike.

    Robust least squares on the logarithms of the colours of faces that two views show; the mean
    gain stays about 1.
    """
    first, second = candidates.view[:, :-1].ravel(), candidates.view[:, 1:].ravel()
    one = candidates.colour[:, :-1].reshape(-1, 3)
    other = candidates.colour[:, 1:].reshape(-1, 3)
    bright = np.maximum(one, other).max(1)
    usable = (first >= 0) & (second >= 0) & (np.minimum(one, other).min(1) > _DARK)
    usable &= bright < _BRIGHT
    first, second, one, other = (x[usable] for x in (first, second, one, other))
    gains = np.zeros((views, 3))
    if len(first):
        log_ratio = (np.log(other) - np.log(one)).astype(np.float64)
        fraction = 1.0 / len(first)
        for channel in range(3):
            gains[:, channel] = _solve_gains(first, second, log_ratio[:, channel], views, fraction)
    limit = np.log(MAX_GAIN)
    return np.exp(gains.clip(-limit, limit)).astype(np.float32)


def _solve_gains(
    first: Int[np.ndarray, "n"],
    second: Int[np.ndarray, "n"],
    log_ratio: Float64[np.ndarray, "n"],
    views: int,
    fraction: float,
) -> Float64[np.ndarray, "v"]:
    """Log gains g with g_first - g_second = log_ratio, each pulled to zero a little.

    The problem is linear: each round solves it directly, without the general least-squares loop.
    """
    gains = np.zeros(views)
    for _ in range(_ROUNDS):
        left = np.abs(gains[first] - gains[second] - log_ratio)
        weight = fraction * views * _HUBER / np.maximum(left, _HUBER)
        rows = np.concatenate([first, second, first, second])
        columns = np.concatenate([first, second, second, first])
        values = np.concatenate([weight, weight, -weight, -weight])
        matrix = sparse.coo_matrix((values, (rows, columns)), (views, views)).tocsc()
        right = np.bincount(first, weight * log_ratio, views)
        right -= np.bincount(second, weight * log_ratio, views)
        gains = spsolve(matrix + _PRIOR * sparse.eye(views, format="csc"), right)
    return gains


def seam_corrections(
    corner_vertex: Int64[np.ndarray, "n"],
    edges: Int64[np.ndarray, "e 2"],
    colour: Float32[np.ndarray, "n 3"],
) -> Float32[np.ndarray, "n 3"]:
    """Colour corrections at the corners of patches that make them agree at shared vertices.

    Smooth within each patch (Lempitsky & Ivanov 2007): minimises the squared differences between
    corrected colours of corners at the same vertex, and those of corrections along edges.

    Args:
        corner_vertex: vertex of the mesh at each corner; a vertex on a seam has several corners.
        edges: pairs of corners along the edges of their patch.
        colour: colour of each corner in its view, 0 to 255.
    """
    count = len(corner_vertex)
    order = np.argsort(corner_vertex, kind="stable")
    same = corner_vertex[order[1:]] == corner_vertex[order[:-1]]
    one, other = order[:-1][same], order[1:][same]
    if not len(one):
        return np.zeros((count, 3), np.float32)
    seams = _differences(one, other, count)
    along = np.sqrt(_STIFFNESS) * _differences(edges[:, 0], edges[:, 1], count)
    matrix = (seams.T @ seams + along.T @ along + 1e-4 * sparse.eye(count)).tocsr()
    wanted = seams.T @ (colour[other] - colour[one]).astype(np.float64)
    inverse = sparse.diags(1 / matrix.diagonal())
    found = [cg(matrix, wanted[:, c], rtol=1e-6, maxiter=1000, M=inverse)[0] for c in range(3)]
    return np.stack(found, -1).astype(np.float32)


def _differences(
    one: Int64[np.ndarray, "k"], other: Int64[np.ndarray, "k"], count: int
) -> sparse.csr_matrix:
    """The matrix that takes values to those at ``one`` minus those at ``other``."""
    rows = np.tile(np.arange(len(one)), 2)
    values = np.repeat([1.0, -1.0], len(one))
    return sparse.coo_matrix(
        (values, (rows, np.concatenate([one, other]))), (len(one), count)
    ).tocsr()


def _corner_colours(
    patches: Patches, views: Mapping[int, DepthMapView], gains: np.ndarray
) -> np.ndarray:
    """Colour of each corner in its view, after the gain, 0 to 255."""
    colour = np.zeros((len(patches.pixel), 3), np.float32)
    own = patches.view[patches.corner_patch]
    for v in np.unique(patches.view):
        here = np.flatnonzero(own == v)
        smooth = cv2.GaussianBlur(views[int(v)].rgb(), (0, 0), 1.0)
        colour[here] = sampled(smooth, patches.pixel[here]) * gains[v]
    return colour


def _plain_colours(
    mesh: Mesh, label: Int32[np.ndarray, "m"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The faces that no view shows, their different colours, and the index of each face's."""
    faces = np.flatnonzero(label < 0)
    if mesh.colours is None:
        colour = np.full((len(faces), 3), GREY)
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
