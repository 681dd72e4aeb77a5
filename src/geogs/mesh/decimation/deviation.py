"""How far points lie from a mesh that should run through them."""

import numpy as np
from jaxtyping import Float, Int

from geogs.threads import worker_count

NEAREST = 3
"""Vertices around a point whose faces are looked at."""


def deviations(
    points: Float[np.ndarray, "k 3"],
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "m 3"],
    known: Int[np.ndarray, "k"] | None = None,
) -> Float[np.ndarray, "k"]:
    """Distance of each point to the nearest face of those around the vertices nearest to it, and
    around one that is known to be near.

    So it is the distance to the mesh, or a little more where faces differ much in size.
    """
    from scipy.spatial import cKDTree

    from geogs.mesh.decimation.deviation_kernels import faces_around, nearest_faces

    is_used = np.zeros(len(vertices), bool)
    is_used[faces] = True
    used = np.flatnonzero(is_used)
    # Of a tree that is asked once, most of the time would go into balancing it.
    tree = cKDTree(vertices[used], balanced_tree=False, compact_nodes=False)
    count = min(NEAREST, len(used))
    _, near = tree.query(points, k=count, workers=worker_count())
    first, around = faces_around(len(vertices), faces)
    corners = vertices.astype(np.float64)[faces]
    near = used[near.reshape(len(points), -1)]
    if known is not None:
        near = np.column_stack([near, known])
    return nearest_faces(points.astype(np.float64), near, first, around, corners)
