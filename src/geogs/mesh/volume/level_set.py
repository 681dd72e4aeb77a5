"""Extraction of triangles from signed distances."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.mesh.tensor_mesh import TensorMesh
from geogs.mesh.volume.marching import march
from geogs.mesh.volume.tsdf import BLOCK, LIMIT, SparseTsdf
from geogs.threads import ordered_map, worker_count

CHUNK = 16
"""Blocks along a side of a chunk."""
_SMALLEST = 1e-3


@dataclass(frozen=True)
class SurfacePart:
    """The surface in one chunk of the space."""

    chunk: tuple[int, int, int]
    """Index of the chunk, of :data:`CHUNK` blocks along a side."""
    keys: Int[np.ndarray, "n"]
    """Key of the voxel edge on which each vertex lies; the same in every part that has it."""
    position: Float[np.ndarray, "n 3"]
    """Positions of the vertices, in voxels."""
    faces: Int[np.ndarray, "m 3"]


def extract_surface(tsdf: SparseTsdf, min_weight: float) -> TensorMesh:
    """Triangles of the zero level, in the world frame of ``tsdf``.

    Only cells whose eight voxels have at least ``min_weight`` give triangles: the far side of the
    band, where distances end in unseen voxels, is no surface. The space is processed in chunks of
    128 voxels that share one layer; a vertex is identified by the voxel edge it lies on, so chunks
    join without seams or double vertices.

    Method: marching cubes (Lorensen and Cline 1987), see :mod:`geogs.mesh.volume.marching`.
    """
    return stitched(surface_parts(tsdf, min_weight), tsdf.voxel)


def surface_parts(tsdf: SparseTsdf, min_weight: float) -> Iterator[SurfacePart]:
    """The surface chunk by chunk, of those chunks that belong to the box of ``tsdf``."""

    def part(place: tuple[Tensor, Tensor]) -> SurfacePart | None:
        chunk = _voxel_chunk(tsdf, min_weight, *place)
        if chunk is None:
            return None
        vertices, axis, triangles = march(chunk.distance, chunk.cell)
        keys = _edge_keys(np.floor(vertices).astype(np.int64) + chunk.origin, axis)
        return SurfacePart(chunk.chunk, keys, vertices + chunk.origin, triangles)

    parts = ordered_map(part, _chunks(tsdf), worker_count())
    return (part for part in parts if part is not None and len(part.faces))


def stitched(parts: Iterable[SurfacePart], voxel: float) -> TensorMesh:
    """Join the parts, which may come in any order and from several volumes, to one mesh."""
    ordered = sorted(parts, key=lambda part: part.chunk)
    if not ordered:
        return TensorMesh.of(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int64))
    keys = np.concatenate([part.keys for part in ordered])
    offsets = np.cumsum([0, *(len(part.keys) for part in ordered)])
    faces = np.concatenate([p.faces + n for p, n in zip(ordered, offsets[:-1], strict=True)])
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    vertices = np.concatenate([part.position for part in ordered])[first] * voxel
    return TensorMesh.of(vertices.astype(np.float32), inverse[faces])


@dataclass(frozen=True)
class _VoxelChunk:
    """A dense box of voxels."""

    chunk: tuple[int, int, int]
    origin: Int[np.ndarray, "3"]
    """First voxel of the box."""
    distance: Float[np.ndarray, "x y z"]
    cell: Bool[np.ndarray, "x y z"]
    """True at a cell's upper corner if all its eight voxels were seen."""


def _chunks(tsdf: SparseTsdf) -> Iterator[tuple[Int[Tensor, "3"], Int[Tensor, "k"]]]:
    """The chunks in the box of a volume, with the blocks that each needs."""
    blocks = tsdf.coordinates
    chunk_of = torch.div(blocks, CHUNK, rounding_mode="floor")
    # A cell reaches one voxel up, so a chunk also needs the first layer of the next blocks.
    for chunk in torch.unique(chunk_of, dim=0):
        low = chunk * CHUNK
        if tsdf.owns(low):
            yield chunk, ((blocks >= low) & (blocks <= low + CHUNK)).all(-1).nonzero()[:, 0]


def _voxel_chunk(
    tsdf: SparseTsdf, min_weight: float, chunk: Int[Tensor, "3"], member: Int[Tensor, "k"]
) -> _VoxelChunk | None:
    """A box with one voxel layer of the next ones; None without a cell or without a zero."""
    blocks = tsdf.coordinates[member]
    first = blocks.amin(0)
    extent = blocks.amax(0) - first + 1
    crop = torch.minimum(extent * BLOCK, ((chunk + 1) * CHUNK - first) * BLOCK + 1).tolist()
    if min(crop) < 2:
        return None
    place = blocks - first
    distance = off_zero(_dense(tsdf.distance[member], place, extent, 1.0, crop))
    weight = _dense(tsdf.weight[member], place, extent, 0.0, crop)
    cell = _seen_cells(weight >= least_weight(min_weight))
    if not bool(cell.any() & (distance.amin() < 0) & (distance.amax() > 0)):
        return None
    x, y, z = chunk.tolist()
    origin = first.cpu().numpy() * BLOCK
    return _VoxelChunk((x, y, z), origin, distance.cpu().numpy(), cell.cpu().numpy())


def least_weight(min_weight: float) -> float:
    """Least weight of a voxel that counts as seen."""
    return max(min_weight, 1e-6)


def off_zero(distance: Float[Tensor, "*v"]) -> Float[Tensor, "*v"]:
    """Move values away from zero, so that a vertex lies strictly inside its edge."""
    away = distance.abs().clamp(min=_SMALLEST)
    return torch.where(distance < 0, -away, away)


def _seen_cells(seen: Bool[Tensor, "x y z"]) -> Bool[Tensor, "x y z"]:
    """Cells whose eight corners were seen, each at its upper corner."""
    cell = seen
    for axis in range(3):
        length = cell.shape[axis]
        both = cell.narrow(axis, 1, length - 1) & cell.narrow(axis, 0, length - 1)
        cell = torch.cat([torch.zeros_like(cell.narrow(axis, 0, 1)), both], axis)
    return cell


def _dense(
    values: Float[Tensor, "k 8 8 8"],
    place: Int[Tensor, "k 3"],
    extent: Int[Tensor, "3"],
    fill: float,
    crop: list[int],
) -> Float[Tensor, "x y z"]:
    nx, ny, nz = (int(n) for n in extent)
    grid = values.new_full((nx, ny, nz, BLOCK, BLOCK, BLOCK), fill)
    grid[place[:, 0], place[:, 1], place[:, 2]] = values
    dense = grid.permute(0, 3, 1, 4, 2, 5).reshape(nx * BLOCK, ny * BLOCK, nz * BLOCK)
    return dense[: crop[0], : crop[1], : crop[2]].contiguous()


def _edge_keys(base: Int[np.ndarray, "n 3"], axis: Int[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
    """A key of the voxel edge on which a vertex lies: its lower voxel and its axis."""
    x, y, z = (base + LIMIT).T
    width = 2 * LIMIT
    return ((x * width + y) * width + z) * 4 + axis
