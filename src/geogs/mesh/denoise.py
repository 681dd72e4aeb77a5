"""Smoothing of facets towards their neighbours' normals, never across an edge."""

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from geogs.mesh.tensor_mesh import vertex_sums

NORMAL_DEVIATION = 0.2
"""Standard deviation of the distance between unit normals of one surface (11 degrees)."""
_NORMAL_ROUNDS = 10
"""Number of means over neighbours: waves over about ten facets are smoothed."""
_VERTEX_ROUNDS = 5
"""Number of steps by which vertices follow the normals."""


def denoised(
    vertices: Float[Tensor, "n 3"], faces: Int[Tensor, "m 3"], reach: float
) -> Float[Tensor, "n 3"]:
    """Vertices of the same faces, moved by at most ``reach`` (map units), with less noisy normals.

    Each facet's normal becomes the mean of its own and of those beyond its three edges, weighted by
    area and by similarity; then vertices move along the normals of their facets towards their
    planes. The common motion of the facets around a vertex is undone, so round shapes do not
    shrink, and vertices of a facet that would be folded over stay. Edges where other than two faces
    meet are not crossed. float64; finite if the mesh is.

    Bilateral normal filtering (Zheng et al. 2011) with the moves of Sun et al. (2007), which are
    weighted by area here.
    """
    start = vertices.double()
    if reach <= 0 or not len(faces):
        return start
    faces = faces.long()
    count = len(start)
    before, area = _facets(start, faces)
    normal = before
    beyond = faces_beyond(faces)
    for _ in range(_NORMAL_ROUNDS):
        normal = _mean_of_neighbours(normal, area, beyond)
    weight = vertex_sums(area, faces, count).clamp(min=1e-300)
    moved = start
    for _ in range(_VERTEX_ROUNDS):
        moved = moved + _plane_offsets(moved, faces, normal, area) / weight
    away = moved - start
    away = away - vertex_sums(away[faces].mean(1) * area, faces, count) / weight
    away = away * (reach / away.norm(dim=1, keepdim=True).clamp(min=reach))
    upright = (before * normal).sum(1).clamp(max=0)
    return _unfolded(start + away, start, faces, normal, upright)


def faces_beyond(faces: Int[Tensor, "m 3"]) -> Int[Tensor, "m 3"]:
    """The face across the edge from each corner to the next; itself unless there is just one."""
    low, high = torch.stack([faces, faces.roll(-1, 1)]).flatten(1).sort(0).values
    _, edge = torch.unique(low * (high.max() + 1) + high, return_inverse=True)
    order = torch.argsort(edge, stable=True)
    sides = torch.bincount(edge)
    first = (sides.cumsum(0) - sides)[sides == 2]
    one, other = order[first], order[first + 1]
    beyond = torch.arange(len(faces), device=faces.device).repeat_interleave(3)
    beyond[one] = other // 3
    beyond[other] = one // 3
    return beyond.view(-1, 3)


def _unfolded(
    moved: Float[Tensor, "n 3"],
    start: Float[Tensor, "n 3"],
    faces: Int[Tensor, "m 3"],
    normal: Float[Tensor, "m 3"],
    upright: Float[Tensor, "m"],
) -> Float[Tensor, "n 3"]:
    """Move the vertices of facets whose cosine to their normal fell below ``upright`` back to their
    start; repeated until there is none, as this may turn the facets around."""
    while True:
        moves = (moved != start).any(1)[faces].any(1)
        folded = moves & ((_facets(moved, faces)[0] * normal).sum(1) < upright)
        if not folded.any():
            return moved
        back = faces[folded].flatten()
        moved = moved.index_copy(0, back, start[back])


def _facets(
    vertices: Float[Tensor, "n 3"], faces: Int[Tensor, "m 3"]
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 1"]]:
    """Unit normals, zero for a facet without an area; twice the areas."""
    a, b, c = vertices[faces].unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    return normalize(normal, dim=1, eps=1e-300), normal.norm(dim=1, keepdim=True)


def _mean_of_neighbours(
    normal: Float[Tensor, "m 3"], area: Float[Tensor, "m 1"], beyond: Int[Tensor, "m 3"]
) -> Float[Tensor, "m 3"]:
    total = normal * area
    for other in beyond.unbind(1):
        apart = (normal - normal[other]).square().sum(1, keepdim=True)
        total = total + normal[other] * area[other] * torch.exp(apart / (-2 * NORMAL_DEVIATION**2))
    return normalize(total, dim=1, eps=1e-300)


def _plane_offsets(
    vertices: Float[Tensor, "n 3"],
    faces: Int[Tensor, "m 3"],
    normal: Float[Tensor, "m 3"],
    area: Float[Tensor, "m 1"],
) -> Float[Tensor, "n 3"]:
    """Sum over each vertex's facets of its offsets to their planes, times their areas."""
    centre = vertices[faces].mean(1)
    total = torch.zeros_like(vertices)
    for corner in faces.unbind(1):
        height = ((centre - vertices[corner]) * normal).sum(1, keepdim=True)
        total.index_add_(0, corner, normal * height * area)
    return total
