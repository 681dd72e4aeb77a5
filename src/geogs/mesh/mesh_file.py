"""Read a mesh that was written as PLY."""

from pathlib import Path

import numpy as np

from geogs.errors import InputError
from geogs.io.ply_reader import PlyElement, read_ply
from geogs.mesh.triangle_mesh import Mesh, vertex_normals


def read_mesh(path: Path) -> Mesh:
    """Read a triangle mesh with its normals, which are computed where there are none, and colours.

    Raises:
        InputError: the file is missing, damaged, or holds no triangles.
    """
    elements = read_ply(path)
    none = PlyElement({}, {})
    vertex, face = (elements.get(name, none) for name in ("vertex", "face"))
    corners = face.lists.get("vertex_indices")
    if not {"x", "y", "z"} <= vertex.columns.keys() or corners is None:
        raise InputError(f"{path} holds no mesh.")
    vertices = _rows(vertex, ("x", "y", "z"), np.float32)
    faces = corners.values.astype(np.int64)
    if (corners.lengths != 3).any() or (
        len(faces) and not 0 <= faces.min() <= faces.max() < len(vertices)
    ):
        raise InputError(f"{path} has faces that are no triangles of its vertices.")
    faces = faces.reshape(-1, 3).astype(np.int32)
    normals = vertex_normals(vertices, faces)
    colours = None
    if {"nx", "ny", "nz"} <= vertex.columns.keys():
        normals = _rows(vertex, ("nx", "ny", "nz"), np.float32)
    if {"red", "green", "blue"} <= vertex.columns.keys():
        colours = _rows(vertex, ("red", "green", "blue"), np.uint8)
    return Mesh(vertices, faces, normals, colours)


def _rows(vertex: PlyElement, names: tuple[str, ...], kind: type) -> np.ndarray:
    return np.stack([vertex.columns[name].astype(kind) for name in names], -1)
