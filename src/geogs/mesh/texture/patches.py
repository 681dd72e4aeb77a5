"""Connected faces that take their colours from one view, and the part of its image they need."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Float64, Int32, Int64
from scipy.sparse.csgraph import connected_components

from geogs.mesh.texture.face_views import image_pixels
from geogs.mesh.triangle_mesh import DepthMapView, Mesh

PADDING = 2
"""Margin of image pixels around a patch, so that sampling finds no foreign ones."""


@dataclass(frozen=True, slots=True)
class Patches:
    """The seen faces of a mesh, cut into patches; a corner is a vertex in a patch."""

    view: Int64[np.ndarray, "p"]
    faces: Int64[np.ndarray, "m"]
    """Indices of the seen faces, patch by patch."""
    start: Int64[np.ndarray, "k"]
    """Index in ``faces`` of each patch's first face; one more at the end."""
    corners: Int64[np.ndarray, "m 3"]
    """Corners of each of ``faces``."""
    corner_vertex: Int64[np.ndarray, "n"]
    corner_patch: Int64[np.ndarray, "n"]
    pixel: Float64[np.ndarray, "n 2"]
    """Pixel position of each corner in the image of its view."""
    box: Int64[np.ndarray, "p 4"]
    """Left, top, right and bottom pixel of the image that a patch needs, all included."""

    def edges(self) -> Int64[np.ndarray, "e 2"]:
        """Pairs of corners along the edges of the faces, each once."""
        c = self.corners
        pairs = np.sort(np.concatenate([c[:, [0, 1]], c[:, [1, 2]], c[:, [2, 0]]]), axis=1)
        return np.unique(pairs, axis=0)


def cut_patches(
    mesh: Mesh,
    views: Mapping[int, DepthMapView],
    label: Int32[np.ndarray, "m"],
    neighbours: Int64[np.ndarray, "e 2"],
) -> Patches:
    """Patches of faces with the same view that are connected by edges."""
    together = neighbours[label[neighbours[:, 0]] == label[neighbours[:, 1]]]
    count = len(label)
    links = sparse.coo_matrix((np.ones(len(together)), together.T), (count, count))
    _, component = connected_components(links, directed=False)
    seen = np.flatnonzero(label >= 0)
    _, patch = np.unique(component[seen], return_inverse=True)
    order = np.argsort(patch, kind="stable")
    faces = seen[order]
    patch = patch[order]
    number = int(patch[-1]) + 1 if len(patch) else 0
    start = np.searchsorted(patch, np.arange(number + 1))
    view = label[faces[start[:-1]]].astype(np.int64)
    key = patch[:, None] * len(mesh.vertices) + mesh.faces[faces].astype(np.int64)
    unique, corners = np.unique(key, return_inverse=True)
    corner_patch, corner_vertex = np.divmod(unique, len(mesh.vertices))
    pixel = np.zeros((len(unique), 2))
    for v in np.unique(view):
        own = np.flatnonzero(view[corner_patch] == v)
        points = mesh.vertices[corner_vertex[own]].astype(np.float64)
        pixel[own] = image_pixels(views[int(v)], points)[0]
    box = _boxes(pixel, corner_patch, number, views, view)
    return Patches(
        view, faces, start, corners.reshape(-1, 3), corner_vertex, corner_patch, pixel, box
    )


def _boxes(
    pixel: Float64[np.ndarray, "n 2"],
    patch: Int64[np.ndarray, "n"],
    number: int,
    views: Mapping[int, DepthMapView],
    view: Int64[np.ndarray, "p"],
) -> Int64[np.ndarray, "p 4"]:
    low, high = np.full((number, 2), np.inf), np.full((number, 2), -np.inf)
    np.minimum.at(low, patch, pixel)
    np.maximum.at(high, patch, pixel)
    sizes = {int(v): views[int(v)].rgb().shape[1::-1] for v in np.unique(view)}
    size = np.array([sizes[int(v)] for v in view]).reshape(-1, 2)
    low = np.maximum(np.floor(low) - PADDING, 0)
    high = np.minimum(np.ceil(high) + PADDING, size - 1)
    return np.concatenate([low, high], 1).astype(np.int64)
