"""From signed distances to triangles."""

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.mesh.tsdf import BLOCK, LIMIT, SparseTsdf
from geogs.mesh.types import Mesh

_CHUNK_BLOCKS = 16
_SMALLEST = 1e-3


def extract_surface(tsdf: SparseTsdf, min_weight: float = 1.5) -> Mesh:
    """Triangles of the zero level, in the world frame of ``tsdf``.

    Only cells whose eight voxels have at least ``min_weight`` give triangles: the far side of the
    band, where distances end in voxels that nobody saw, is no surface. The space is worked
    through in chunks of 128 voxels that share one layer; a vertex is identified by the voxel edge
    it lies on, so chunks join without seams or double vertices.

    Method: marching cubes (Lorensen and Cline 1987) with Lewiner's topology (2003), scikit-image.
    """
    keys, positions, faces, offset = [], [], [], 0
    for origin, distance, seen in _chunks(tsdf, min_weight):
        vertices, triangles = _march(distance, seen)
        if not len(triangles):
            continue
        position = vertices.astype(np.float64) + origin
        keys.append(_edge_keys(position))
        positions.append(position)
        faces.append(triangles.astype(np.int64) + offset)
        offset += len(position)
    if not faces:
        return Mesh.from_triangles(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    _, first, inverse = np.unique(np.concatenate(keys), return_index=True, return_inverse=True)
    vertices = np.concatenate(positions)[first] * tsdf.voxel
    return Mesh.from_triangles(
        vertices.astype(np.float32), inverse[np.concatenate(faces)].astype(np.int32)
    )


def _chunks(
    tsdf: SparseTsdf, min_weight: float
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """First voxel, distances and seen flags of dense boxes that overlap by one voxel layer."""
    blocks = tsdf.coordinates
    chunk_of = torch.div(blocks, _CHUNK_BLOCKS, rounding_mode="floor")
    # A cell reaches one voxel up, so a chunk also needs the first layer of the next blocks.
    for chunk in torch.unique(chunk_of, dim=0):
        low = chunk * _CHUNK_BLOCKS
        member = ((blocks >= low) & (blocks <= low + _CHUNK_BLOCKS)).all(-1).nonzero()[:, 0]
        first = blocks[member].amin(0)
        extent = blocks[member].amax(0) - first + 1
        last = low + _CHUNK_BLOCKS
        crop = torch.minimum(extent * BLOCK, (last - first) * BLOCK + 1).tolist()
        place = blocks[member] - first
        distance = _dense(tsdf.distance[member], place, extent, 1.0, crop)
        weight = _dense(tsdf.weight[member], place, extent, 0.0, crop)
        yield first.cpu().numpy() * BLOCK, distance, weight >= max(min_weight, 1e-6)


def _dense(
    values: Float[Tensor, "k 8 8 8"],
    place: Int[Tensor, "k 3"],
    extent: Int[Tensor, "3"],
    fill: float,
    crop: list[int],
) -> Float[np.ndarray, "x y z"]:
    nx, ny, nz = (int(n) for n in extent)
    grid = values.new_full((nx, ny, nz, BLOCK, BLOCK, BLOCK), fill)
    grid[place[:, 0], place[:, 1], place[:, 2]] = values
    dense = grid.permute(0, 3, 1, 4, 2, 5).reshape(nx * BLOCK, ny * BLOCK, nz * BLOCK)
    return dense[: crop[0], : crop[1], : crop[2]].cpu().numpy()


def _march(distance: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    from skimage.measure import marching_cubes

    nothing = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)
    if min(distance.shape) < 2:
        return nothing
    cell = seen.copy()
    for axis in range(3):
        upper = np.roll(cell, 1, axis)
        np.moveaxis(upper, axis, 0)[0] = False
        cell &= upper
    # scikit-image's mask speaks of the cell whose upper corner it is, which is how `cell` is laid
    # out. No value is quite zero: a vertex then lies strictly inside its edge.
    distance = np.where(distance < 0, np.minimum(distance, -_SMALLEST), distance)
    distance = np.where(distance >= 0, np.maximum(distance, _SMALLEST), distance)
    if not cell.any() or distance.min() > 0 or distance.max() < 0:
        return nothing
    try:
        vertices, faces, _, _ = marching_cubes(
            distance, 0.0, mask=cell, gradient_direction="descent", allow_degenerate=True
        )
    except RuntimeError:  # how scikit-image says that no masked cell has a zero
        return nothing
    return vertices, faces


def _edge_keys(position: Float[np.ndarray, "n 3"]) -> np.ndarray:
    """A key of the voxel edge (or cell, for Lewiner's inner vertex) on which a vertex lies."""
    base = np.floor(position + 0.2 * _SMALLEST)
    inner = position - base > 0.4 * _SMALLEST
    axis = np.where(inner.sum(1) > 1, 3, inner.argmax(1))
    x, y, z = (base.astype(np.int64) + LIMIT).T
    width = 2 * LIMIT
    return ((x * width + y) * width + z) * 4 + axis
