"""Extraction of a mesh in boxes of space, stitched to the mesh that one volume would give.

All boxes sample the same grid of voxels, and each has one layer of its neighbours' blocks: where
two boxes meet they compute the same distances, so the same vertices on the same voxel edges.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from geogs.config import MeshConfig
from geogs.geometry.camera import Camera
from geogs.mesh.clean import cleaned
from geogs.mesh.extract import VolumePlan, integrate, pixel_planes
from geogs.mesh.triangle_mesh import DepthMapView, Mesh
from geogs.mesh.volume.contraction import Contraction
from geogs.mesh.volume.free_space import FreeSpace
from geogs.mesh.volume.level_set import CHUNK, SurfacePart, stitched, surface_parts
from geogs.mesh.volume.pixel_planes import widest
from geogs.mesh.volume.tsdf import BLOCK, BlockBox, SparseTsdf, blocks_seen, meets_frustum
from geogs.threads import on_one_torch_thread


@dataclass(frozen=True)
class MeshBlock:
    """Surface and free space of one box of space."""

    parts: tuple[SurfacePart, ...]
    free: FreeSpace


def blocks_of(view: DepthMapView, plan: VolumePlan) -> Int[Tensor, "k 3"]:
    """Coordinates of the blocks in which the surface of a view lies, with its band."""
    planes, T_cw = pixel_planes(view, plan)
    return blocks_seen(planes, T_cw, plan.voxel, plan.truncation, plan.contraction)


def boxes_of(blocks: Int[np.ndarray, "k 3"], most: int) -> list[BlockBox]:
    """Divide blocks into boxes of at most ``most`` blocks, or else as small as possible.

    Args:
        blocks: coordinates, each once.
        most: blocks in a box. A chunk, in which surfaces are extracted, is not divided.
    """
    chunks, counts = np.unique(np.floor_divide(blocks, CHUNK), axis=0, return_counts=True)
    return _divided(chunks, counts, most) if len(chunks) else []


def _divided(
    chunks: Int[np.ndarray, "c 3"], counts: Int[np.ndarray, "c"], most: int
) -> list[BlockBox]:
    low, high = chunks.min(axis=0), chunks.max(axis=0) + 1
    if len(chunks) == 1 or counts.sum() <= most:
        (a, b, c), (d, e, f) = (low * CHUNK).tolist(), (high * CHUNK).tolist()
        return [BlockBox((a, b, c), (d, e, f))]
    axis = int(np.argmax(high - low))
    along = np.bincount(chunks[:, axis] - low[axis], counts)
    half = int(np.searchsorted(np.cumsum(along), counts.sum() / 2))
    border = low[axis] + min(max(half, 0) + 1, len(along) - 1)
    below = chunks[:, axis] < border
    return [
        *_divided(chunks[below], counts[below], most),
        *_divided(chunks[~below], counts[~below], most),
    ]


def sees_box(camera: Camera, T_cw: Tensor, plan: VolumePlan, box: BlockBox) -> bool:
    """Whether a view may change a voxel of a box; other views need not be fused there."""
    side = plan.voxel * BLOCK
    low, high = (np.array(c, dtype=np.float64) for c in (box.low, box.high))
    middle = (low + high + 1) * side / 2
    radius = float(np.linalg.norm(high + 1 - low)) * side / 2
    centre, reach = plan.contraction.balls(torch.from_numpy(middle)[None], radius)
    point = centre @ T_cw[:3, :3].double().mT + T_cw[:3, 3].double()
    band = math.inf if plan.contraction else widest(plan.truncation * plan.voxel)
    return bool(meets_frustum(point, reach, camera, plan.max_depth + band))


@on_one_torch_thread
def mesh_block(
    views: Iterable[DepthMapView],
    plan: VolumePlan,
    box: BlockBox,
    min_weight: float,
    device: torch.device | str = "cpu",
) -> MeshBlock:
    """Fuse the views in one box of space and extract its surface.

    ``views`` are those that see the box, in the order of fusion; others change nothing.
    """
    tsdf = SparseTsdf(plan.voxel, plan.truncation, device, box=box, contraction=plan.contraction)
    for view in views:
        integrate(tsdf, view, plan)
    return MeshBlock(tuple(surface_parts(tsdf, min_weight)), FreeSpace.of(tsdf, min_weight))


def stitched_blocks(blocks: Sequence[MeshBlock], plan: VolumePlan, config: MeshConfig) -> Mesh:
    """The mesh of all boxes in contracted space, cleaned as one; neither coloured nor decimated.

    Raises:
        InputError: there is no surface.
    """
    mesh = stitched((part for block in blocks for part in block.parts), plan.voxel)
    found, normals = cleaned(mesh, config, FreeSpace.joined([block.free for block in blocks]))
    return Mesh(found.vertices.numpy(), found.faces.to(torch.int32).numpy(), normals.numpy())


def expanded_mesh(mesh: Mesh, contraction: Contraction) -> Mesh:
    """Transform a mesh of contracted space to the world, with its colours."""
    if not contraction:
        return mesh
    vertices = contraction.expanded(torch.from_numpy(mesh.vertices)).numpy()
    return replace(Mesh.from_triangles(vertices, mesh.faces), colours=mesh.colours)


def near(mesh: Mesh, box: BlockBox, plan: VolumePlan) -> Bool[np.ndarray, "n"]:
    """Mask of the vertices of a mesh in contracted space that lie in a box."""
    side = plan.voxel * BLOCK
    block = np.floor_divide(mesh.vertices.astype(np.float64), side)
    return np.asarray(((block >= box.low) & (block < box.high)).all(axis=1))
