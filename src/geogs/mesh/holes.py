"""Small holes of a mesh, closed where nobody looked through them."""

from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Bool, Float, Int

from geogs.mesh.triangle_mesh import Mesh, cross

IsFree = Callable[[Float[np.ndarray, "k 3"]], Bool[np.ndarray, "k"]]
"""Which points lie in space that was seen to be free."""

Loop = list[int]
"""Vertices around a hole, in the order in which faces that close it go round."""


def close_holes(mesh: Mesh, most_edges: int, is_free: IsFree) -> Mesh:
    """Close holes with ``most_edges`` or fewer edges by a fan around their middle.

    A hole stays open where its middle is free, or where the fan would fold over: such an edge is
    one of the surface, no gap in it. Colours are made later.
    """
    loops = [loop for loop in border_loops(mesh.faces) if 3 <= len(loop) <= most_edges]
    loops = [loop for loop in loops if _is_flat(mesh, loop)]
    if not loops:
        return mesh
    middles = np.array([mesh.vertices[loop].astype(np.float64).mean(axis=0) for loop in loops])
    closed = np.flatnonzero(~is_free(middles))
    vertices, faces, normals = [mesh.vertices], [mesh.faces], [mesh.normals]
    count = len(mesh.vertices)
    for number in closed.tolist():
        loop = loops[number]
        middle = np.full(len(loop), count)
        faces.append(np.stack([loop, np.roll(loop, -1), middle], -1).astype(np.int32))
        vertices.append(middles[number : number + 1].astype(np.float32))
        mean = mesh.normals[loop].astype(np.float64).sum(axis=0)
        normals.append((mean / np.linalg.norm(mean))[None].astype(np.float32))
        count += 1
    return Mesh(np.concatenate(vertices), np.concatenate(faces), np.concatenate(normals))


def border_loops(faces: Int[np.ndarray, "m 3"]) -> Iterator[Loop]:
    """Closed chains of edges that one face has, against the direction in which it has them.

    Chains through a vertex where two borders meet are left out.
    """
    from geogs.mesh.face_kernels import border_edges

    border = border_edges(np.ascontiguousarray(faces), int(faces.max(initial=-1)) + 1)
    starts, counts = np.unique(border[:, 1], return_counts=True)
    single = set(starts[counts == 1].tolist())
    following = {end: start for start, end in border.tolist() if end in single}
    while following:
        first, vertex = following.popitem()
        loop = [first]
        while vertex in following:
            loop.append(vertex)
            vertex = following.pop(vertex)
        if vertex == first:
            yield loop


def _is_flat(mesh: Mesh, loop: Loop) -> bool:
    """Whether all triangles of the fan turn the same side up as the surface around."""
    corners = mesh.vertices[loop].astype(np.float64)
    middle, up = corners.mean(axis=0), mesh.normals[loop].astype(np.float64).sum(axis=0)
    normals = cross(np.roll(corners, -1, axis=0) - corners, middle - corners)
    length = np.linalg.norm(normals, axis=1) * np.linalg.norm(up)
    return bool((normals @ up > 0.2 * length).all() and (length > 0).all())
