"""Exposure compensation of the views, and of the patches where they meet."""

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Float32, Float64, Int, Int64
from scipy.sparse.linalg import cg, spsolve

from geogs.mesh.texture.candidates import Candidates

MAX_GAIN = 2.0
"""Largest factor by which a view is made brighter or darker."""
_DARK, _BRIGHT = 10.0, 245.0
_PRIOR, _ROUNDS, _HUBER = 0.02, 5, 0.05
_STIFFNESS = 0.1
"""Weight of equal corrections at both ends of an edge; that of equal colours at seams is 1."""


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
