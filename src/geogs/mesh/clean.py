"""Cleaning of an extracted mesh on its device: specks removed, small holes closed."""

from collections.abc import Callable, Iterator

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.config import MeshConfig
from geogs.errors import InputError
from geogs.mesh.tensor_mesh import TensorMesh
from geogs.mesh.triangle_mesh import Mesh

LEAST_OF_LARGEST = 2e-4
"""Parts with fewer faces than this fraction of the largest part's are removed: specks. A trunk or
a sign has less than a thousandth of the faces of a road with its fronts, which are one part."""
CLOSED_HOLES = 8
"""Most edges of a hole that is closed, unless a ray crosses it."""

IsFree = Callable[[Float[np.ndarray, "k 3"]], Bool[np.ndarray, "k"]]
"""Function that returns whether points lie in space that was seen to be free."""


def cleaned(
    mesh: TensorMesh, config: MeshConfig, is_free: IsFree
) -> tuple[TensorMesh, Float[Tensor, "n 3"]]:
    """Remove specks and close small holes that no ray crosses; return the mesh and its normals.

    Raises InputError if no surface is left.
    """
    mesh = large_components(
        without_degenerate_faces(mesh),
        config.min_component_faces,
        LEAST_OF_LARGEST,
        config.max_components,
    )
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
    areas = []
    squares = []
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

    faces = mesh.faces.numpy()
    n = len(mesh.vertices)
    a, b = faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()
    links = coo_matrix((np.ones(len(a), np.int8), (a, b)), shape=(n, n))
    return torch.from_numpy(connected_components(links, directed=False)[1])


def border_edges(mesh: TensorMesh) -> Int[Tensor, "e 2"]:
    """Edges (start, end) of faces that no face has in the other direction, unordered."""
    start = mesh.faces
    end = mesh.faces.roll(-1, 1)
    count = len(mesh.vertices)
    keys = 2 * (torch.minimum(start, end) * count + torch.maximum(start, end)) + (start > end)
    keys = keys.flatten().sort().values.unique_consecutive()
    alone = torch.ones_like(keys, dtype=torch.bool)
    is_pair = (keys[1:] ^ 1) == keys[:-1]
    alone[1:] &= ~is_pair
    alone[:-1] &= ~is_pair
    keys = keys[alone]
    low = keys // 2 // count
    high = keys // 2 % count
    turned = keys % 2 == 1
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
    device = mesh.faces.device
    count = len(mesh.vertices)
    vertices = [mesh.vertices]
    normals = [mesh.normals()]
    faces = [mesh.faces]
    for loops in border_loops(border_edges(mesh).cpu().numpy(), most_edges):
        index = torch.from_numpy(loops).to(device)
        corners = vertices[0][index].cpu().numpy().astype(np.float64)
        middle = corners.mean(axis=1)
        up = normals[0][index].cpu().numpy().astype(np.float64).sum(axis=1)
        closed = np.flatnonzero(_are_flat(corners, middle, up))
        closed = closed[~is_free(middle[closed])]
        number = np.broadcast_to(count + np.arange(len(closed))[:, None], loops[closed].shape)
        turned = np.roll(loops[closed], -1, axis=1)
        fans = np.stack([loops[closed], turned, number], -1).reshape(-1, 3)
        length = np.linalg.norm(up[closed], axis=1, keepdims=True)
        faces.append(torch.from_numpy(fans).to(device))
        vertices.append(torch.from_numpy(middle[closed].astype(np.float32)).to(device))
        normals.append(torch.from_numpy((up[closed] / length).astype(np.float32)).to(device))
        count += len(closed)
    return TensorMesh(torch.cat(vertices), torch.cat(faces)), torch.cat(normals)


def border_loops(
    border: Int[np.ndarray, "e 2"], most_edges: int
) -> Iterator[Int[np.ndarray, "n k"]]:
    """Closed chains of three to ``most_edges`` edges that one face has, against their direction.

    Chains of the same number of edges come together, each from its lowest vertex on. Chains through
    a vertex where two borders meet are left out.
    """
    ends, first, counts = np.unique(border[:, 1], return_index=True, return_counts=True)
    ends = ends[counts == 1]
    starts = border[first[counts == 1], 0]
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
