"""What is removed from an extracted mesh."""

import numpy as np
from jaxtyping import Int

from geogs.config import MeshConfig
from geogs.errors import InputError
from geogs.mesh.holes import IsFree, close_holes
from geogs.mesh.triangle_mesh import Mesh

LEAST_OF_LARGEST = 2e-4
"""Parts with fewer faces than this fraction of the largest part's are removed: specks. Of
a road with its fronts, one part, a trunk or a sign is less than a thousandth."""
CLOSED_HOLES = 8
"""Holes with so many edges or fewer are closed, unless somebody looked through them."""


def cleaned(mesh: Mesh, config: MeshConfig, is_free: IsFree) -> Mesh:
    """Without what is no surface, and with small holes closed where nobody looked through them.

    Raises InputError if no surface is left.
    """
    mesh = remove_degenerate_faces(mesh)
    mesh = keep_components(
        mesh, config.min_component_faces, LEAST_OF_LARGEST, config.max_components
    )
    if not len(mesh.faces):
        raise no_surface(config)
    return close_holes(mesh, CLOSED_HOLES, is_free)


def no_surface(config: MeshConfig) -> InputError:
    """The error that no surface is left."""
    return InputError(
        f"No surface was seen with a total weight of {config.min_weight:g}; lower min-weight "
        "or use more views."
    )


def remove_degenerate_faces(mesh: Mesh) -> Mesh:
    """Without faces that repeat a vertex or whose squared area is below 1e-12 of the
    squared mean edge length squared, and without the vertices this leaves unused."""
    from geogs.mesh.face_kernels import face_sizes

    a, b, c = mesh.faces.T
    area = np.empty(len(mesh.faces))
    scale = face_sizes(mesh.vertices, np.ascontiguousarray(mesh.faces), area)
    distinct = (a != b) & (b != c) & (c != a)
    return keep_faces(mesh, distinct & (area > 1e-12 * scale**2))


def keep_components(
    mesh: Mesh, min_faces: int, min_fraction: float = 0.0, max_components: int | None = None
) -> Mesh:
    """Connected parts that are large enough.

    A part stays if it has at least ``min_faces`` faces and at least ``min_fraction`` of the faces
    of the largest; of those the ``max_components`` largest, all if none is given.
    """
    if not len(mesh.faces):
        return mesh
    label, count = _components(mesh)
    keep = count >= max(min_faces, min_fraction * count.max())
    if max_components is not None:
        rank = np.empty(len(count), int)
        rank[np.argsort(-count, kind="stable")] = np.arange(len(count))
        keep &= rank < max_components
    return keep_faces(mesh, keep[label])


def keep_faces(mesh: Mesh, keep: np.ndarray) -> Mesh:
    """The faces where ``keep`` is true and the vertices that they use."""
    if keep.all():
        return mesh
    faces = mesh.faces[keep]
    used = np.zeros(len(mesh.vertices), bool)
    used[faces] = True
    renumbered = (np.cumsum(used) - 1).astype(np.int32)
    return Mesh(
        mesh.vertices[used],
        renumbered[faces].reshape(-1, 3),
        mesh.normals[used],
        None if mesh.colours is None else mesh.colours[used],
    )


def _components(mesh: Mesh) -> tuple[Int[np.ndarray, "m"], Int[np.ndarray, "c"]]:
    """Label of each face and number of faces of each label; faces connect by a shared vertex.

    A vertex without a face has a label of its own, which no face has.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    a, b = mesh.faces[:, [0, 1]].ravel(), mesh.faces[:, [1, 2]].ravel()
    n = len(mesh.vertices)
    links = coo_matrix((np.ones(len(a), np.int8), (a, b)), shape=(n, n))
    _, of_vertex = connected_components(links, directed=False)
    label = of_vertex[mesh.faces[:, 0]]
    return label, np.bincount(label, minlength=of_vertex.max() + 1)
