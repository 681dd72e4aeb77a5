"""Closing of small holes of a mesh that no ray crosses."""

from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Bool, Float, Int

IsFree = Callable[[Float[np.ndarray, "k 3"]], Bool[np.ndarray, "k"]]
"""Function that returns whether points lie in space that was seen to be free."""
Look = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Function that returns positions and normals of vertices."""


def closing_fans(
    border: Int[np.ndarray, "e 2"], count: int, look: Look, most_edges: int, is_free: IsFree
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3"], Int[np.ndarray, "m 3"]]:
    """Vertices, normals and faces of fans around the middles of holes with ``most_edges`` or fewer
    edges.

    The vertices are numbered from ``count`` on; ``border`` are the edges (start, end) that one
    face has.
    """
    vertices, normals = [np.zeros((0, 3), np.float32)], [np.zeros((0, 3), np.float32)]
    faces = [np.zeros((0, 3), np.int64)]
    for loops in border_loops(border, most_edges):
        corners, around = (values.astype(np.float64) for values in look(loops))
        middle, up = corners.mean(axis=1), around.sum(axis=1)
        closed = np.flatnonzero(_are_flat(corners, middle, up))
        closed = closed[~is_free(middle[closed])]
        number = np.broadcast_to(count + np.arange(len(closed))[:, None], loops[closed].shape)
        turned = np.roll(loops[closed], -1, axis=1)
        faces.append(np.stack([loops[closed], turned, number], -1).reshape(-1, 3))
        vertices.append(middle[closed].astype(np.float32))
        length = np.linalg.norm(up[closed], axis=1, keepdims=True)
        normals.append((up[closed] / length).astype(np.float32))
        count += len(closed)
    return np.concatenate(vertices), np.concatenate(normals), np.concatenate(faces)


def border_loops(
    border: Int[np.ndarray, "e 2"], most_edges: int
) -> Iterator[Int[np.ndarray, "n k"]]:
    """Closed chains of three to ``most_edges`` edges that one face has, against their direction.

    Chains of the same number of edges come together, each from its lowest vertex on. Chains through
    a vertex where two borders meet are left out.
    """
    ends, first, counts = np.unique(border[:, 1], return_index=True, return_counts=True)
    ends, starts = ends[counts == 1], border[first[counts == 1], 0]
    place = np.searchsorted(ends, starts).clip(max=max(len(ends) - 1, 0))
    # One more index, to which open chains lead, leads to itself.
    following = np.append(np.where(ends[place] == starts, place, len(ends)), len(ends))
    paths = np.arange(len(ends))[:, None]
    for edges in range(1, most_edges + 1):
        last = following[paths[:, -1]]
        is_closed = last == paths[:, 0]
        if edges >= 3 and is_closed.any():
            yield ends[paths[is_closed]]
        # A loop is followed from its lowest vertex alone.
        goes_on = ~is_closed & (last > paths[:, 0]) & (last < len(ends))
        paths = np.column_stack([paths[goes_on], last[goes_on]])


def _are_flat(
    corners: Float[np.ndarray, "n k 3"],
    middle: Float[np.ndarray, "n 3"],
    up: Float[np.ndarray, "n 3"],
) -> Bool[np.ndarray, "n"]:
    """Whether all triangles of a fan turn the same side up as the surface around."""
    normals = np.cross(np.roll(corners, -1, axis=1) - corners, middle[:, None] - corners)
    length = np.linalg.norm(normals, axis=-1) * np.linalg.norm(up, axis=-1)[:, None]
    turn = (normals * up[:, None]).sum(-1)
    return np.asarray(((turn > 0.2 * length) & (length > 0)).all(axis=1))
