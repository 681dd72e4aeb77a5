"""Marching cubes over all blocks of a volume at once."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from geogs.mesh.tensor_mesh import TensorMesh
from geogs.mesh.volume.level_set import least_weight, off_zero
from geogs.mesh.volume.marching import CORNERS, EDGES, triangle_counts, triangle_table
from geogs.mesh.volume.tsdf import BLOCK, SparseTsdf

_VOXELS = BLOCK**3
_BATCH = 16384
"""Blocks whose cells are processed together."""


@dataclass(frozen=True)
class _Cells:
    """Cells that the surface passes."""

    block: Int[Tensor, "c"]
    voxel: Int[Tensor, "c 3"]
    """Lowest voxel of each, in the block."""
    case: Int[Tensor, "c"]
    """Bit b is set if corner b lies inside."""


def device_surface(tsdf: SparseTsdf, min_weight: float) -> TensorMesh:
    """The zero level of a volume without a box, on its device.

    The same as :func:`geogs.mesh.volume.level_set.extract_surface`, with vertices and faces in the
    order of the volume's blocks.
    """
    above = _blocks_above(tsdf)
    cells = _passed_cells(tsdf, above, min_weight)
    keys, faces = torch.unique(_edges_of_triangles(cells, above), return_inverse=True)
    return TensorMesh(_positions(keys, tsdf, above), faces)


def _blocks_above(tsdf: SparseTsdf) -> Int[Tensor, "k 8"]:
    """Slots of the blocks that begin at the eight corners of each block; -1 where there is none."""
    steps = torch.from_numpy(CORNERS).to(tsdf.device)
    return tsdf.slots_of(tsdf.coordinates[:, None] + steps)


def _passed_cells(tsdf: SparseTsdf, above: Int[Tensor, "k 8"], min_weight: float) -> _Cells:
    """Cells whose eight voxels were seen, on both sides of the surface."""
    is_seen = tsdf.weight >= least_weight(min_weight)
    state = (tsdf.distance < 0).to(torch.uint8) + 2 * is_seen.to(torch.uint8)
    found = [_passed(state, rows, first) for first, rows in _batches(above)]
    index, case = (torch.cat(part) for part in zip(*found, strict=True))
    x, y, z = index // BLOCK**2 % BLOCK, index // BLOCK % BLOCK, index % BLOCK
    return _Cells(index // _VOXELS, torch.stack([x, y, z], -1), case)


def _batches(above: Int[Tensor, "k 8"]) -> list[tuple[int, Int[Tensor, "b 8"]]]:
    return [(n, above[n : n + _BATCH]) for n in range(0, max(len(above), 1), _BATCH)]


def _passed(
    state: UInt8[Tensor, "k 8 8 8"], above: Int[Tensor, "b 8"], first: int
) -> tuple[Int[Tensor, "c"], Int[Tensor, "c"]]:
    """Indices among all voxels, and cases, of passed cells of some blocks, from ``first`` on."""
    around = _with_layers_above(state, above)
    case = torch.zeros((len(above), BLOCK, BLOCK, BLOCK), dtype=torch.uint8, device=state.device)
    is_seen = torch.full_like(case, 2)
    for number, (i, j, k) in enumerate(CORNERS.tolist()):
        corner = around[:, i : i + BLOCK, j : j + BLOCK, k : k + BLOCK]
        case |= (corner & 1) << number
        is_seen &= corner
    passed = (is_seen > 0) & (case > 0) & (case < 255)
    index = passed.flatten().nonzero()[:, 0]
    return index + first * _VOXELS, case.flatten()[index].long()


def _with_layers_above(
    state: UInt8[Tensor, "k 8 8 8"], above: Int[Tensor, "b 8"]
) -> UInt8[Tensor, "b 9 9 9"]:
    """Some blocks with the next layer of voxels along each axis; 0 where there is no block."""
    shape = (len(above), BLOCK + 1, BLOCK + 1, BLOCK + 1)
    around = torch.zeros(shape, dtype=torch.uint8, device=state.device)
    for number, steps in enumerate(CORNERS.tolist()):
        x, y, z = (slice(BLOCK, BLOCK + 1) if step else slice(BLOCK) for step in steps)
        a, b, c = (slice(1) if step else slice(BLOCK) for step in steps)
        block = above[:, number]
        values = state[:, a, b, c][block.clamp(min=0)]
        around[:, x, y, z] = values * (block >= 0)[:, None, None, None]
    return around


def _edges_of_triangles(cells: _Cells, above: Int[Tensor, "k 8"]) -> Int[Tensor, "m 3"]:
    """The voxel edges of the vertices of each triangle: index of the lower voxel, and axis."""
    device = above.device
    counts = torch.from_numpy(triangle_counts()).to(device).long()[cells.case]
    table = torch.from_numpy(triangle_table()).to(device).long()
    cell = torch.arange(len(counts), device=device).repeat_interleave(counts)
    number = torch.arange(len(cell), device=device) - (counts.cumsum(0) - counts)[cell]
    edge = table[cells.case[cell], number]
    corner, axis = torch.from_numpy(EDGES).to(device)[edge].unbind(-1)
    voxel = cells.voxel[cell][:, None] + torch.from_numpy(CORNERS).to(device)[corner]
    place = _place(cells.block[cell][:, None].expand(-1, 3), voxel, above)
    return place * 3 + axis


def _place(
    block: Int[Tensor, "*v"], voxel: Int[Tensor, "*v 3"], above: Int[Tensor, "k 8"]
) -> Int[Tensor, "*v"]:
    """Indices, among all voxels, of those of a block or one layer above it."""
    beyond = voxel // BLOCK
    block = above[block, beyond[..., 0] + 2 * beyond[..., 1] + 4 * beyond[..., 2]]
    x, y, z = (voxel - beyond * BLOCK).unbind(-1)
    return ((block * BLOCK + x) * BLOCK + y) * BLOCK + z


def _positions(
    keys: Int[Tensor, "n"], tsdf: SparseTsdf, above: Int[Tensor, "k 8"]
) -> Float[Tensor, "n 3"]:
    """Positions at which the surface passes voxel edges."""
    place, axis = keys // 3, keys % 3
    block = place // _VOXELS
    inner = torch.stack([place // BLOCK**2 % BLOCK, place // BLOCK % BLOCK, place % BLOCK], -1)
    along = torch.nn.functional.one_hot(axis, 3)
    values = tsdf.distance.flatten()
    here = off_zero(values[place])
    there = off_zero(values[_place(block, inner + along, above)])
    voxel = tsdf.coordinates[block] * BLOCK + inner
    return ((voxel + along * (here / (here - there)).double()[:, None]) * tsdf.voxel).float()
