"""Distances of points to a mesh that should run through them."""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.geometry.neighbors import nearest_neighbors
from geogs.threads import worker_count

_NEAREST = 3
"""Vertices around a point whose faces are tested."""


def host_deviations(
    points: Float[np.ndarray, "k 3"],
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "m 3"],
    known: Int[np.ndarray, "k"],
) -> Float[np.ndarray, "k"]:
    """Distance of each point to the nearest face of those around the vertices nearest to it, and
    around one that is known to be near; every vertex has a face.

    It is the distance to the mesh, or a little more where faces differ much in size.
    """
    from scipy.spatial import cKDTree

    from geogs.mesh.decimation.collapse_kernels import rings
    from geogs.mesh.decimation.deviation_kernels import nearest_faces

    # For a single query most of the time would go into balancing the tree.
    tree = cKDTree(vertices, balanced_tree=False, compact_nodes=False)
    _, near = tree.query(points, k=_NEAREST, workers=worker_count())
    near = np.column_stack([near, known])
    first, corners = rings(faces.ravel(), len(vertices))
    triangles = vertices.astype(np.float64)[faces]
    return nearest_faces(points.astype(np.float64), near, first, corners // 3, triangles)


def device_deviations(
    points: Float[Tensor, "k 3"],
    vertices: Float[Tensor, "n 3"],
    faces: Int[Tensor, "m 3"],
    known: Int[Tensor, "k"],
) -> Float[Tensor, "k"]:
    """:func:`host_deviations` on any device."""
    _, near = nearest_neighbors(points, vertices, _NEAREST)
    near = torch.cat([near, known[:, None]], 1)
    vertex, corners = faces.flatten().sort(stable=True)
    first = torch.searchsorted(vertex, near.flatten().to(vertex.dtype))
    count = torch.searchsorted(vertex, near.flatten().to(vertex.dtype), right=True) - first
    pair = torch.arange(len(count), device=faces.device).repeat_interleave(count)
    number = torch.arange(len(pair), device=faces.device) - (count.cumsum(0) - count)[pair]
    face, point = corners[first[pair] + number] // 3, pair // near.shape[1]
    triangles = vertices.double()[faces[face].long()]
    away = triangle_distances(points.double()[point], triangles)
    return away.new_full((len(points),), torch.inf).scatter_reduce(0, point, away, "amin")


def triangle_distances(
    points: Float[Tensor, "k 3"], triangles: Float[Tensor, "k 3 3"]
) -> Float[Tensor, "k"]:
    """Distance of each point to a triangle of its own (its corners in rows)."""
    edges = triangles.roll(-1, 1) - triangles
    normal = torch.linalg.cross(edges[:, 0], -edges[:, 2])
    length = normal.norm(dim=-1)
    offset = points[:, None] - triangles
    turn = (torch.linalg.cross(edges, offset) * normal[:, None]).sum(-1)
    inside = (turn >= 0).all(-1) & (length > 0)
    squared = edges.square().sum(-1)
    fraction = (offset * edges).sum(-1) / torch.where(squared > 0, squared, 1.0)
    foot = fraction.clamp(0, 1)[..., None] * edges
    to_edges = (offset - foot).norm(dim=-1).amin(-1)
    to_plane = (offset[:, 0] * normal).sum(-1).abs() / torch.where(length > 0, length, 1.0)
    return torch.where(inside, to_plane, to_edges)
