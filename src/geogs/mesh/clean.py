"""Cleaning of an extracted mesh on its device: specks removed, small holes closed."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.config import MeshConfig
from geogs.errors import InputError
from geogs.mesh.holes import IsFree, closing_fans
from geogs.mesh.tensor_mesh import TensorMesh
from geogs.mesh.triangle_mesh import Mesh

LEAST_OF_LARGEST = 2e-4
"""Parts with fewer faces than this fraction of the largest part's are removed: specks. A trunk or
a sign has less than a thousandth of the faces of a road with its fronts, which are one part."""
CLOSED_HOLES = 8
"""Most edges of a hole that is closed, unless a ray crosses it."""


def cleaned(
    mesh: TensorMesh, config: MeshConfig, is_free: IsFree
) -> tuple[TensorMesh, Float[Tensor, "n 3"]]:
    """Remove specks and close small holes that no ray crosses; return the mesh and its normals.

    Raises InputError if no surface is left.
    """
    mesh = large_components(
        without_degenerate_faces(mesh), config.min_component_faces, LEAST_OF_LARGEST,
        config.max_components,
    )  # fmt: skip
    if not len(mesh.faces):
        raise InputError(
            f"No surface was seen with a total weight of {config.min_weight:g}; lower min-weight "
            "or use more views."
        )
    return with_closed_holes(mesh, CLOSED_HOLES, is_free)


def remove_degenerate_faces(mesh: Mesh) -> Mesh:
    """:func:`without_degenerate_faces` of a mesh with normals and colours."""
    if not len(mesh.faces):
        return mesh
    return keep_faces(mesh, _have_areas(TensorMesh.of(mesh.vertices, mesh.faces)).numpy())


def keep_faces(mesh: Mesh, keep: np.ndarray) -> Mesh:
    """The faces where ``keep`` is true and the vertices that they use."""
    if keep.all():
        return mesh
    faces = mesh.faces[keep]
    used = np.zeros(len(mesh.vertices), bool)
    used[faces] = True
    renumbered = (np.cumsum(used) - 1).astype(np.int32)
    return Mesh(
        mesh.vertices[used],
        renumbered[faces].reshape(-1, 3),
        mesh.normals[used],
        None if mesh.colours is None else mesh.colours[used],
    )


def without_degenerate_faces(mesh: TensorMesh) -> TensorMesh:
    """Remove faces that repeat a vertex or whose squared area is below 1e-12 of the
    squared mean edge length squared, and the vertices this leaves unused."""
    return mesh.kept(_have_areas(mesh)) if len(mesh.faces) else mesh


def _have_areas(mesh: TensorMesh) -> Bool[Tensor, "m"]:
    areas, squares = [], []
    for _, u, v in mesh.sides():
        areas.append(torch.linalg.cross(u, v).square().sum(-1))
        squares.append(u.square().sum() + v.square().sum() + (v - u).square().sum())
    mean = torch.stack(squares).sum() / (3 * len(mesh.faces))
    i, j, k = mesh.faces.unbind(1)
    return (i != j) & (j != k) & (k != i) & (torch.cat(areas) > 1e-12 * mean**2)


def large_components(
    mesh: TensorMesh, min_faces: int, min_fraction: float, max_components: int | None
) -> TensorMesh:
    """Connected parts that are large enough; faces connect by a shared vertex.

    A part stays if it has at least ``min_faces`` faces, at least ``min_fraction`` of the faces of
    the largest, and is among the ``max_components`` largest (None for all).
    """
    if not len(mesh.faces):
        return mesh
    found = components_on_host if mesh.faces.device.type == "cpu" else vertex_components
    label = found(mesh)[mesh.faces[:, 0]]
    _, label, count = torch.unique(label, return_inverse=True, return_counts=True)
    keep = count >= torch.clamp(min_fraction * count.amax().double(), min=min_faces)
    if max_components is not None:
        keep[torch.argsort(-count, stable=True)[max_components:]] = False
    return mesh.kept(keep[label])


def vertex_components(mesh: TensorMesh) -> Int[Tensor, "n"]:
    """Label each vertex with the lowest vertex of its connected part, on any device.

    Labels begin as the vertices themselves. The vertices that label a face's corners take the
    lowest of these labels, then labels are followed to their own labels, until nothing changes.
    """
    label = torch.arange(len(mesh.vertices), device=mesh.faces.device)
    while True:
        named = label[mesh.faces]
        lowest = named.amin(1, keepdim=True).expand(-1, 3)
        new = label.scatter_reduce(0, named.flatten(), lowest.flatten(), "amin")
        new = new[new[new]]
        if torch.equal(new, label):
            return label
        label = new


def components_on_host(mesh: TensorMesh) -> Int[Tensor, "n"]:
    """The number of the connected part of each vertex, on a CPU."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    faces, n = mesh.faces.numpy(), len(mesh.vertices)
    a, b = faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()
    links = coo_matrix((np.ones(len(a), np.int8), (a, b)), shape=(n, n))
    return torch.from_numpy(connected_components(links, directed=False)[1])


def border_edges(mesh: TensorMesh) -> Int[Tensor, "e 2"]:
    """Edges (start, end) of faces that no face has in the other direction, unordered."""
    start, end, count = mesh.faces, mesh.faces.roll(-1, 1), len(mesh.vertices)
    keys = 2 * (torch.minimum(start, end) * count + torch.maximum(start, end)) + (start > end)
    keys = keys.flatten().sort().values.unique_consecutive()
    alone = torch.ones_like(keys, dtype=torch.bool)
    is_pair = (keys[1:] ^ 1) == keys[:-1]
    alone[1:] &= ~is_pair
    alone[:-1] &= ~is_pair
    keys = keys[alone]
    low, high, turned = keys // 2 // count, keys // 2 % count, keys % 2 == 1
    edges = torch.stack([torch.where(turned, high, low), torch.where(turned, low, high)], -1)
    return edges[low != high]


def with_closed_holes(
    mesh: TensorMesh, most_edges: int, is_free: IsFree
) -> tuple[TensorMesh, Float[Tensor, "n 3"]]:
    """Close holes with ``most_edges`` or fewer edges by a fan around their middle; return the mesh
    and its normals.

    A hole stays open if its middle is free, or if the fan would fold over: such a border is a real
    end of the surface, not a gap.
    """
    vertices, normals, device = mesh.vertices, mesh.normals(), mesh.faces.device

    def look(loops: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        index = torch.from_numpy(loops).to(device)
        return vertices[index].cpu().numpy(), normals[index].cpu().numpy()

    border = border_edges(mesh).cpu().numpy()
    fans = closing_fans(border, len(vertices), look, most_edges, is_free)
    middle, up, faces = (torch.from_numpy(part).to(device) for part in fans)
    mesh = TensorMesh(torch.cat([vertices, middle]), torch.cat([mesh.faces, faces]))
    return mesh, torch.cat([normals, up])
