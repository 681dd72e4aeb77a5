"""What is removed from a mesh on its device, and which of its holes are closed."""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.config import MeshConfig
from geogs.mesh.clean import CLOSED_HOLES, LEAST_OF_LARGEST, no_surface
from geogs.mesh.device.tensor_mesh import TensorMesh
from geogs.mesh.holes import IsFree, closing_fans


def device_cleaned(
    mesh: TensorMesh, config: MeshConfig, is_free: IsFree
) -> tuple[TensorMesh, Float[Tensor, "n 3"]]:
    """What :func:`geogs.mesh.clean.cleaned` does; the mesh and its normals.

    Raises InputError if no surface is left.
    """
    mesh = without_degenerate_faces(mesh)
    mesh = large_components(
        mesh, config.min_component_faces, LEAST_OF_LARGEST, config.max_components
    )
    if not len(mesh.faces):
        raise no_surface(config)
    return _with_closed_holes(mesh, is_free)


def without_degenerate_faces(mesh: TensorMesh) -> TensorMesh:
    """As :func:`geogs.mesh.clean.remove_degenerate_faces`."""
    if not len(mesh.faces):
        return mesh
    a, b, c = mesh.corners()
    u, v, w = b - a, c - a, c - b
    area = torch.linalg.cross(u, v).square().sum(-1)
    scale = torch.stack([u, v, w]).square().sum(-1).mean()
    i, j, k = mesh.faces.unbind(1)
    return mesh.kept((i != j) & (j != k) & (k != i) & (area > 1e-12 * scale**2))


def large_components(
    mesh: TensorMesh, min_faces: int, min_fraction: float, max_components: int | None
) -> TensorMesh:
    """As :func:`geogs.mesh.clean.keep_components`."""
    if not len(mesh.faces):
        return mesh
    label = vertex_components(mesh)[mesh.faces[:, 0]]
    _, label, count = torch.unique(label, return_inverse=True, return_counts=True)
    keep = count >= torch.clamp(min_fraction * count.amax(), min=min_faces)
    if max_components is not None:
        keep[torch.argsort(-count, stable=True)[max_components:]] = False
    return mesh.kept(keep[label])


def vertex_components(mesh: TensorMesh) -> Int[Tensor, "n"]:
    """The lowest vertex that each is connected with.

    All vertices name a lower one, at first themselves. Those named by a face's corners learn the
    lowest of these, then every vertex names what the one that it names does, until nothing changes.
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


def border_edges(mesh: TensorMesh) -> Int[Tensor, "e 2"]:
    """Edges (start, end) of faces that no face has in the other direction, in no order."""
    start, end = mesh.faces.flatten(), mesh.faces.roll(-1, 1).flatten()
    low, high = torch.minimum(start, end), torch.maximum(start, end)
    pair = low * len(mesh.vertices) + high
    keys = torch.unique(2 * pair + (start > end))[:, None]
    other = torch.cat([keys[1:], keys[:1]], 0), torch.cat([keys[-1:], keys[:-1]], 0)
    alone = (torch.cat(other, 1) != (keys ^ 1)).all(1)
    keys = keys[alone, 0]
    low, high = (keys // 2) // len(mesh.vertices), (keys // 2) % len(mesh.vertices)
    edges = torch.stack([low, high], -1)
    edges = torch.where((keys % 2 == 1)[:, None], edges.flip(1), edges)
    return edges[low != high]


def _with_closed_holes(
    mesh: TensorMesh, is_free: IsFree
) -> tuple[TensorMesh, Float[Tensor, "n 3"]]:
    vertices, normals, device = mesh.vertices, mesh.normals(), mesh.faces.device

    def look(loops: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        index = torch.from_numpy(loops).to(device)
        return vertices[index].cpu().numpy(), normals[index].cpu().numpy()

    border = border_edges(mesh).cpu().numpy()
    fans = closing_fans(border, len(vertices), look, CLOSED_HOLES, is_free)
    new = [torch.from_numpy(part).to(device) for part in (fans.vertices, fans.normals, fans.faces)]
    mesh = TensorMesh(torch.cat([vertices, new[0]]), torch.cat([mesh.faces, new[2]]))
    return mesh, torch.cat([normals, new[1]])
