"""Extraction of triangles from signed distances, by marching cubes.

Lorensen and Cline (1987), with a table that is derived instead of written down. On each face of a
cell the corners inside are cut off by segments that lead from where the walk around the face enters
the inside to where it next leaves it. Since that looks at the face alone, the two cells that share
a face cut it alike, and the surface has no holes, however ambiguous its corners are.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Int8, UInt8
from torch import Tensor

from geogs.mesh.tensor_mesh import TensorMesh
from geogs.mesh.volume.tsdf import BLOCK, LIMIT, SparseTsdf
from geogs.threads import ordered_map, worker_count

CHUNK = 16
"""Blocks along a side of a chunk."""
_BATCH = 16384
"""Blocks whose cells a device processes together."""
CORNERS = np.array([[c & 1, c >> 1 & 1, c >> 2 & 1] for c in range(8)])
"""Corners of a cell, as steps from its lowest."""
EDGES = np.array([[c, axis] for axis in range(3) for c in range(8) if not c >> axis & 1])
"""Edges of a cell: lower corner and axis."""
MOST_TRIANGLES = 5
"""Most triangles of a cell."""

Loop = list[int]
"""Edges of a cell that a piece of the surface passes in turn."""


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
    """
    return stitched(surface_parts(tsdf, min_weight), tsdf.voxel)


def surface_parts(tsdf: SparseTsdf, min_weight: float) -> Iterator[SurfacePart]:
    """The surface chunk by chunk, of those chunks that belong to the box of ``tsdf``."""
    part = partial(_part, tsdf, min_weight)
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


def _chunks(tsdf: SparseTsdf) -> Iterator[tuple[Int[Tensor, "3"], Int[Tensor, "k"]]]:
    """The chunks in the box of a volume, with the blocks that each needs."""
    blocks = tsdf.coordinates
    chunk_of = torch.div(blocks, CHUNK, rounding_mode="floor")
    # A cell reaches one voxel up, so a chunk also needs the first layer of the next blocks.
    for chunk in torch.unique(chunk_of, dim=0):
        low = chunk * CHUNK
        if tsdf.owns(low):
            yield chunk, ((blocks >= low) & (blocks <= low + CHUNK)).all(-1).nonzero()[:, 0]


def _part(
    tsdf: SparseTsdf, min_weight: float, place: tuple[Int[Tensor, "3"], Int[Tensor, "k"]]
) -> SurfacePart | None:
    """The surface in a chunk with one voxel layer of the next ones; None if it has no cell that was
    seen or no change of sign."""
    chunk, member = place
    blocks = tsdf.coordinates[member]
    first = blocks.amin(0)
    extent = blocks.amax(0) - first + 1
    crop = torch.minimum(extent * BLOCK, ((chunk + 1) * CHUNK - first) * BLOCK + 1).tolist()
    if min(crop) < 2:
        return None
    inner = blocks - first
    distance = _off_zero(_dense(tsdf.distance[member], inner, extent, 1.0, crop))
    weight = _dense(tsdf.weight[member], inner, extent, 0.0, crop)
    cell = _seen_cells(weight >= _least_weight(min_weight))
    if not bool(cell.any() & (distance.amin() < 0) & (distance.amax() > 0)):
        return None
    vertices, axis, triangles = march(distance.cpu().numpy(), cell.cpu().numpy())
    origin = first.cpu().numpy() * BLOCK
    keys = _edge_keys(np.floor(vertices).astype(np.int64) + origin, axis)
    x, y, z = chunk.tolist()
    return SurfacePart((x, y, z), keys, vertices + origin, triangles)


def _least_weight(min_weight: float) -> float:
    """Least weight of a voxel that counts as seen."""
    return max(min_weight, 1e-6)


def _off_zero(distance: Float[Tensor, "*v"]) -> Float[Tensor, "*v"]:
    """Move values away from zero, so that a vertex lies strictly inside its edge."""
    away = distance.abs().clamp(min=1e-3)
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


def device_surface(tsdf: SparseTsdf, min_weight: float) -> TensorMesh:
    """The zero level of a volume without a box, on its device: marching cubes over all blocks.

    The same as :func:`extract_surface`, with vertices and faces in the order of the volume's
    blocks.
    """
    steps = torch.from_numpy(CORNERS).to(tsdf.device)
    # Slots of the blocks that begin at the corners of each block; -1 where there is none.
    above = tsdf.slots_of(tsdf.coordinates[:, None] + steps)
    place, case = _passed_cells(tsdf, above, min_weight)
    keys, faces = torch.unique(_edges_of_triangles(place, case, above), return_inverse=True)
    return TensorMesh(_positions(keys, tsdf, above), faces)


def _passed_cells(
    tsdf: SparseTsdf, above: Int[Tensor, "k 8"], min_weight: float
) -> tuple[Int[Tensor, "c"], Int[Tensor, "c"]]:
    """Cells whose eight voxels were seen, on both sides of the surface: the index of the lowest
    voxel among all voxels, and the case, whose bit b is set if corner b lies inside."""
    is_seen = tsdf.weight >= _least_weight(min_weight)
    state = (tsdf.distance < 0).to(torch.uint8) + 2 * is_seen.to(torch.uint8)
    starts = range(0, max(len(above), 1), _BATCH)
    found = [_passed(state, above[first : first + _BATCH], first) for first in starts]
    places, cases = zip(*found, strict=True)
    return torch.cat(places), torch.cat(cases)


def _passed(
    state: UInt8[Tensor, "k 8 8 8"], above: Int[Tensor, "b 8"], first: int
) -> tuple[Int[Tensor, "c"], Int[Tensor, "c"]]:
    """:func:`_passed_cells` of some blocks, from ``first`` on."""
    around = _with_layers_above(state, above)
    case = torch.zeros((len(above), BLOCK, BLOCK, BLOCK), dtype=torch.uint8, device=state.device)
    is_seen = torch.full_like(case, 2)
    for number, (i, j, k) in enumerate(CORNERS.tolist()):
        corner = around[:, i : i + BLOCK, j : j + BLOCK, k : k + BLOCK]
        case |= (corner & 1) << number
        is_seen &= corner
    passed = (is_seen > 0) & (case > 0) & (case < 255)
    index = passed.flatten().nonzero()[:, 0]
    return index + first * BLOCK**3, case.flatten()[index].long()


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


def _edges_of_triangles(
    place: Int[Tensor, "c"], case: Int[Tensor, "c"], above: Int[Tensor, "k 8"]
) -> Int[Tensor, "m 3"]:
    """The voxel edges of the vertices of each triangle: index of the lower voxel, and axis."""
    device = above.device
    counts = torch.from_numpy(triangle_counts()).to(device).long()[case]
    table = torch.from_numpy(triangle_table()).to(device).long()
    cell = torch.arange(len(counts), device=device).repeat_interleave(counts)
    number = torch.arange(len(cell), device=device) - (counts.cumsum(0) - counts)[cell]
    edge = table[case[cell], number]
    corner, axis = torch.from_numpy(EDGES).to(device)[edge].unbind(-1)
    lowest = place[cell][:, None]
    voxel = _in_block(lowest) + torch.from_numpy(CORNERS).to(device)[corner]
    block = (lowest // BLOCK**3).expand(-1, 3)
    return _place(block, voxel, above) * 3 + axis


def _in_block(place: Int[Tensor, "*v"]) -> Int[Tensor, "*v 3"]:
    """Position in its block of a voxel with an index among all voxels."""
    return torch.stack([place // BLOCK**2 % BLOCK, place // BLOCK % BLOCK, place % BLOCK], -1)


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
    place = keys // 3
    axis = keys % 3
    block = place // BLOCK**3
    inner = _in_block(place)
    along = torch.nn.functional.one_hot(axis, 3)
    values = tsdf.distance.flatten()
    here = _off_zero(values[place])
    there = _off_zero(values[_place(block, inner + along, above)])
    voxel = tsdf.coordinates[block] * BLOCK + inner
    return ((voxel + along * (here / (here - there)).double()[:, None]) * tsdf.voxel).float()


def march(
    distance: Float[np.ndarray, "x y z"], seen: Bool[np.ndarray, "x y z"]
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "n"], Int[np.ndarray, "m 3"]]:
    """Vertices in voxels, the axis of the voxel edge on which each lies, and triangles.

    Args:
        distance: negative inside; no value may be zero.
        seen: cells that give triangles, each at its upper corner.

    Triangles are counter-clockwise seen from outside. A voxel edge has one vertex.
    """
    from geogs.mesh.volume.volume_kernels import count_triangles, find_vertices, write_triangles

    cells = np.ascontiguousarray(seen)
    counts = triangle_counts()
    number = np.full((*distance.shape, 3), -1, np.int32)
    values = np.ascontiguousarray(distance, dtype=np.float32)
    total = count_triangles(values, cells, counts)
    faces = np.empty((total, 3), np.int64)
    vertices = find_vertices(values, cells, number)
    write_triangles(values, cells, counts, triangle_table(), EDGES, CORNERS, number, faces)
    position = vertices[:, :3]
    axis = vertices[:, 3].astype(np.int64)
    return np.ascontiguousarray(position), axis, faces


@cache
def triangle_counts() -> Int8[np.ndarray, "256"]:
    """Number of triangles of each case; bit c of a case is set if corner c lies inside."""
    return np.array([len(triangles_of(case)) for case in range(256)], np.int8)


@cache
def triangle_table() -> Int8[np.ndarray, "256 t 3"]:
    """Edges of the triangles of each case; unused entries are -1."""
    table = np.full((256, MOST_TRIANGLES, 3), -1, np.int8)
    for case in range(256):
        for n, triangle in enumerate(triangles_of(case)):
            table[case, n] = triangle
    return table


def triangles_of(case: int) -> list[tuple[int, int, int]]:
    """The triangles of a case: its loops as fans."""
    return [t for loop in loops_of(case) for t in _fan(loop)]


def loops_of(case: int) -> list[Loop]:
    """The edges of a cell that each piece of the surface passes, counter-clockwise from outside."""
    inside = [bool(case >> c & 1) for c in range(8)]
    following: dict[int, int] = {}
    for face in cell_faces():
        steps = [(face[k], face[(k + 1) % 4]) for k in range(4)]
        for k, (a, b) in enumerate(steps):
            if inside[a] or not inside[b]:
                continue
            leaves = next(
                step for n in range(1, 4) if (step := steps[(k + n) % 4]) and not inside[step[1]]
            )
            following[_edge(a, b)] = _edge(*leaves)
    found: list[Loop] = []
    while following:
        loop = [min(following)]
        while (after := following.pop(loop[-1])) != loop[0]:
            loop.append(after)
        found.append(loop)
    return found


def cell_faces() -> list[list[int]]:
    """The corners of each face of a cell, counter-clockwise seen from outside."""
    found = []
    for axis in range(3):
        u, v = 1 << (axis + 1) % 3, 1 << (axis + 2) % 3
        around = [0, u, u | v, v]
        found += [around[::-1], [corner | 1 << axis for corner in around]]
    return found


def _fan(loop: Loop) -> list[tuple[int, int, int]]:
    """Triangles of a loop, from the corner with fewest of their inner edges in a face of the cell.

    An edge in a face could meet one of the cell behind the face.
    """
    turns = [loop[k:] + loop[:k] for k in range(len(loop))]
    best = min(turns, key=lambda t: sum(_on_one_face(t[0], t[k]) for k in range(2, len(t) - 1)))
    return [(best[0], best[k], best[k + 1]) for k in range(1, len(best) - 1)]


def _on_one_face(first: int, second: int) -> bool:
    ends = [{int(c), int(c) | 1 << int(axis)} for c, axis in (EDGES[first], EDGES[second])]
    return any(ends[0] | ends[1] <= set(face) for face in cell_faces())


def _edge(a: int, b: int) -> int:
    """The number of the edge between two corners."""
    low = min(a, b)
    axis = (a ^ b).bit_length() - 1
    return EDGES.tolist().index([low, axis])
