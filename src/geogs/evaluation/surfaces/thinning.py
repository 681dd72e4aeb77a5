"""Point sets of even density: regular samples of a mesh, and greedy thinning."""

import numpy as np
from jaxtyping import Bool, Float

from geogs.evaluation.surfaces.surface import Surface


def thin(points: Float[np.ndarray, "n 3"], radius: float) -> Bool[np.ndarray, "n"]:
    """Which points stay when each, in order, removes all later ones at most ``radius`` away.

    A removed point removes none. Takes time in proportion to the points.
    """
    from geogs.evaluation.surfaces.thinning_kernels import thin_in_order

    kept = np.zeros(len(points), bool)
    # From the middle, cell numbers stay small whatever the frame.
    centred = points - points.mean(0) if len(points) else points
    thin_in_order(np.ascontiguousarray(centred, np.float64), radius, kept)
    return kept


def dense_points(mesh: Surface, spacing: float) -> Float[np.ndarray, "n 3"]:
    """All vertices, then a regular grid of points inside every triangle.

    With edges u and v from the first corner the grid has floor(|u| / s) by floor(|v| / s) cells,
    s being ``spacing`` times sqrt(|u| |v| / |u x v|), so that a cell's area is about the squared
    spacing; the points are the centres of the cells, where they are in the triangle. Source: the
    Python version of DTU's evaluation that comes with 2DGS.
    """
    from geogs.evaluation.surfaces.thinning_kernels import grid_samples

    vertices = np.ascontiguousarray(mesh.vertices, np.float64)
    faces = np.ascontiguousarray(mesh.faces, np.int64)
    count = grid_samples(vertices, faces, spacing, np.empty((0, 3)))
    samples = np.empty((count, 3))
    grid_samples(vertices, faces, spacing, samples)
    return np.concatenate([vertices, samples])
