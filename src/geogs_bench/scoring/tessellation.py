"""Coarse meshes cut into small triangles, so that measures over vertices mean something."""

import numpy as np

from geogs.evaluation.surfaces.surface import Surface

_MOST_FACES = 4_000_000


def with_short_edges(mesh: Surface, longest: float) -> Surface:
    """The same surface, triangles halved across their longest edge until none is too long.

    Halving keeps thin triangles few. Neighbours that are halved across their common edge share
    the new corner; a neighbour that is not keeps that edge whole.
    """
    vertices, faces = mesh.vertices, mesh.faces.astype(np.int64)
    while True:
        corners = vertices[faces]
        lengths = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=-1)
        long = np.flatnonzero(lengths.max(1) > longest)
        if not len(long) or len(faces) + len(long) > _MOST_FACES:
            return Surface(vertices, faces)
        # Turn each triangle so that its longest edge is the one from a to b.
        order = lengths[long].argmax(1)[:, None] + np.arange(3)
        a, b, c = np.take_along_axis(faces[long], order % 3, axis=1).T
        key = np.minimum(a, b) * len(vertices) + np.maximum(a, b)
        _, first, middle = np.unique(key, return_index=True, return_inverse=True)
        middle = middle.reshape(-1) + len(vertices)
        vertices = np.concatenate([vertices, (vertices[a[first]] + vertices[b[first]]) / 2])
        faces[long] = np.stack([a, middle, c], 1)
        faces = np.concatenate([faces, np.stack([middle, b, c], 1)])
