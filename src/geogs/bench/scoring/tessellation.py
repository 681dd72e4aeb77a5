"""Coarse meshes cut into small triangles, so that measures over vertices mean something."""

import numpy as np

from geogs.evaluation.surface import Surface

_MOST_FACES = 4_000_000


def with_short_edges(mesh: Surface, longest: float) -> Surface:
    """The same surface, triangles with a longer edge than ``longest`` cut into four, repeatedly.

    New corners are not shared between triangles.
    """
    vertices, faces = mesh.vertices, mesh.faces
    while True:
        a, b, c = (vertices[faces[:, i]] for i in range(3))
        edges = np.stack([b - a, c - b, a - c])
        long = np.linalg.norm(edges, axis=-1).max(0) > longest
        if not long.any() or len(faces) + 3 * int(long.sum()) > _MOST_FACES:
            return Surface(vertices, faces)
        a, b, c = a[long], b[long], c[long]
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        quarters = np.concatenate([
            np.stack(corners, 1)
            for corners in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
        ])  # fmt: skip
        added = np.arange(3 * len(quarters)).reshape(-1, 3) + len(vertices)
        vertices = np.concatenate([vertices, quarters.reshape(-1, 3)])
        faces = np.concatenate([faces[~long], added])
