"""The loops over the voxels of a volume on the CPU: averaging in, marching cubes; in numba."""

import numpy as np
from numba import njit

_ONE, _TWO, _NEAREST = np.float32(1), np.float32(2), np.float32(1e-6)


@njit(cache=True, nogil=True, error_model="numpy")
def average_in(
    slots, block, local, corner, step, middle, radius,
    table, truncation, width, height, distance, weight,
):  # fmt: skip
    """Update the voxels of some blocks (k,) of ``distance`` and ``weight`` (blocks, voxels).

    ``block`` (k, 3) and ``local`` (3, voxels) add up to a voxel's u z, v z and z in the image;
    ``corner`` (k, 3) and ``step`` (3, voxels) to its position from the centre of a ``Contraction``
    with a ``radius``, which may be infinite; ``middle`` (3) has u z, v z and z of that centre.
    ``table`` (pixels, 4) and ``truncation`` (pixels), in map units, are those of ``PixelPlanes``.
    """
    is_contracted = np.isfinite(radius)
    for k in range(len(slots)):
        slot = slots[k]
        for j in range(local.shape[1]):
            x, y = block[k, 0] + local[0, j], block[k, 1] + local[1, j]
            z = block[k, 2] + local[2, j]
            if is_contracted:
                a, b = corner[k, 0] + step[0, j], corner[k, 1] + step[1, j]
                c = corner[k, 2] + step[2, j]
                away = np.sqrt(a * a + b * b + c * c) / radius
                if not away < _TWO - _NEAREST:
                    continue
                if away > _ONE:
                    stretch = _ONE / (away * (_TWO - away))
                    x = middle[0] + stretch * (x - middle[0])
                    y = middle[1] + stretch * (y - middle[1])
                    z = middle[2] + stretch * (z - middle[2])
            if not z > _NEAREST:
                continue
            inverse = _ONE / z
            u, v = x * inverse, y * inverse
            column, row = np.rint(u), np.rint(v)
            if not (column >= 0 and row >= 0 and column < width and row < height):
                continue
            pixel = np.int64(row) * width + np.int64(column)
            plane = table[pixel]
            surface = plane[0] + plane[1] * (u - column) + plane[2] * (v - row)
            ahead = (_ONE / surface - z) / truncation[pixel]
            if not ahead > -_ONE:
                continue
            gain = plane[3] * min(_TWO + _TWO * ahead, _ONE)
            if not gain > 0:
                continue
            new = weight[slot, j] + gain
            change = min(ahead, _ONE) - distance[slot, j]
            distance[slot, j] += change * (gain / new)
            weight[slot, j] = new


@njit(cache=True, nogil=True, error_model="numpy")
def _case(distance, x, y, z):
    """Bits of the corners, of the cell below an upper corner, that lie inside."""
    case = 0
    for c in range(8):
        if distance[x - 1 + (c & 1), y - 1 + (c >> 1 & 1), z - 1 + (c >> 2 & 1)] < 0:
            case |= 1 << c
    return case


@njit(cache=True, nogil=True, error_model="numpy")
def count_triangles(distance, seen, counts):
    """Count the triangles of all cells that were seen."""
    total = 0
    for x in range(1, seen.shape[0]):
        for y in range(1, seen.shape[1]):
            for z in range(1, seen.shape[2]):
                if seen[x, y, z]:
                    total += counts[_case(distance, x, y, z)]
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _touches(seen, x, y, z, axis):
    """Whether a cell that was seen has the edge from a voxel along an axis."""
    for i in range(2):
        for j in range(2):
            a = x + (1 if axis == 0 else i)
            b = y + (1 if axis == 1 else (i if axis == 0 else j))
            c = z + (1 if axis == 2 else j)
            if (
                0 < a < seen.shape[0]
                and 0 < b < seen.shape[1]
                and 0 < c < seen.shape[2]
                and seen[a, b, c]
            ):
                return True
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def find_vertices(distance, seen, number):
    """Position and axis of the vertices; ``number`` receives the index of each edge's vertex."""
    found = 0
    room = 1024
    vertices = np.empty((room, 4), np.float64)
    nx, ny, nz = distance.shape
    for x in range(nx):
        for y in range(ny):
            for z in range(nz):
                here = distance[x, y, z]
                for axis in range(3):
                    a, b, c = x + (axis == 0), y + (axis == 1), z + (axis == 2)
                    if a >= nx or b >= ny or c >= nz:
                        continue
                    there = distance[a, b, c]
                    if (here < 0) == (there < 0) or not _touches(seen, x, y, z, axis):
                        continue
                    if found == room:
                        room *= 2
                        larger = np.empty((room, 4), np.float64)
                        for n in range(found):  # numba takes seconds to compile it as one copy
                            for k in range(4):
                                larger[n, k] = vertices[n, k]
                        vertices = larger
                    vertices[found, 0] = x
                    vertices[found, 1] = y
                    vertices[found, 2] = z
                    vertices[found, axis] += here / (here - there)
                    vertices[found, 3] = axis
                    number[x, y, z, axis] = found
                    found += 1
    return vertices[:found]


@njit(cache=True, nogil=True, error_model="numpy")
def write_triangles(distance, seen, counts, table, edges, corners, number, faces):
    """Fill ``faces`` with the vertices of the triangles of all cells that were seen."""
    at = 0
    for x in range(1, seen.shape[0]):
        for y in range(1, seen.shape[1]):
            for z in range(1, seen.shape[2]):
                if not seen[x, y, z]:
                    continue
                case = _case(distance, x, y, z)
                for n in range(counts[case]):
                    for k in range(3):
                        corner, axis = edges[table[case, n, k]]
                        a = x - 1 + corners[corner, 0]
                        b = y - 1 + corners[corner, 1]
                        c = z - 1 + corners[corner, 2]
                        faces[at, k] = number[a, b, c, axis]
                    at += 1
