"""The loops of parallel edge collapse over vertices and faces, in numba.

Corner 3 f + k is that of face f at its k-th vertex, and stands for the edge from there to the next
vertex of the face. Of the two corners of an edge the one at the lower vertex stands for it.
"""

import math

import numpy as np
from numba import njit

NONE = 2**62
"""Rank of no edge."""
_TOWARDS_MIDDLE = 1e-3
_FLATTEST = 0.01
_SHORT_FIRST = 1e-4
"""A hundredth, squared: an edge is as dear as if its vertices moved by that part of its length, so
that in planes short edges come first."""
_LEAST_COSINE = 0.2
_SCATTER, _GATHER = 2654435769, 340573321
"""Their product is one, of 32 bits."""
_LEVEL = 21
"""Bits of a cost that ranks leave out; what is left tells costs apart by a quarter or less."""


@njit(cache=True, nogil=True, error_model="numpy")
def rings(faces, count):
    """Where the corners at each of ``count`` vertices begin in the list of them, and that list."""
    first = np.zeros(count + 1, np.int32)
    for f in range(len(faces)):
        for k in range(3):
            first[faces[f, k] + 1] += 1
    for v in range(count):
        first[v + 1] += first[v]
    place = first[:-1].copy()
    corners = np.empty(3 * len(faces), np.int32)
    for f in range(len(faces)):
        for k in range(3):
            v = faces[f, k]
            corners[place[v]] = 3 * f + k
            place[v] += 1
    return first, corners


@njit(cache=True, nogil=True, error_model="numpy")
def begin(low, high, position, faces, first, corners, quadric, fixed):
    """Quadrics of vertices ``low`` to ``high``, and which lie on an edge without two faces.

    A quadric is the sum, over the faces around, of their area times the squared distance to their
    plane: xx, xy, xz, x, yy, yz, y, zz, z and 1.
    """
    for v in range(low, high):
        quadric[v] = 0.0
        is_fixed = False
        for i in range(first[v], first[v + 1]):
            f, k = corners[i] // 3, corners[i] % 3
            _add_plane(position, faces, f, quadric, v)
            after, before = faces[f, (k + 1) % 3], faces[f, (k + 2) % 3]
            twins = 0
            for j in range(first[v], first[v + 1]):
                g, m = corners[j] // 3, corners[j] % 3
                next_one, last_one = faces[g, (m + 1) % 3], faces[g, (m + 2) % 3]
                twins += (last_one == after) + (next_one == before)
                if j != i and (next_one == after or last_one == before):
                    is_fixed = True
            is_fixed |= twins != 2
        fixed[v] = is_fixed


@njit(cache=True, nogil=True, error_model="numpy")
def _normal(position, a, b, c):
    ux, uy, uz = (
        position[b, 0] - position[a, 0],
        position[b, 1] - position[a, 1],
        position[b, 2] - position[a, 2],
    )
    vx, vy, vz = (
        position[c, 0] - position[a, 0],
        position[c, 1] - position[a, 1],
        position[c, 2] - position[a, 2],
    )
    return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


@njit(cache=True, nogil=True, error_model="numpy")
def _add_plane(position, faces, f, quadric, v):
    a = faces[f, 0]
    nx, ny, nz = _normal(position, a, faces[f, 1], faces[f, 2])
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    if not length > 0:
        return
    area = 0.5 * length
    nx, ny, nz = nx / length, ny / length, nz / length
    d = -(nx * position[a, 0] + ny * position[a, 1] + nz * position[a, 2])
    quadric[v, 0] += area * nx * nx
    quadric[v, 1] += area * nx * ny
    quadric[v, 2] += area * nx * nz
    quadric[v, 3] += area * nx * d
    quadric[v, 4] += area * ny * ny
    quadric[v, 5] += area * ny * nz
    quadric[v, 6] += area * ny * d
    quadric[v, 7] += area * nz * nz
    quadric[v, 8] += area * nz * d
    quadric[v, 9] += area * d * d


@njit(cache=True, nogil=True, error_model="numpy")
def merged(position, quadric, a, b):
    """Where two vertices are merged and what that costs: the least of their quadrics' sum.

    Where the planes around leave the place open, it is near the middle.
    """
    xx, xy = quadric[a, 0] + quadric[b, 0], quadric[a, 1] + quadric[b, 1]
    xz, x1 = quadric[a, 2] + quadric[b, 2], quadric[a, 3] + quadric[b, 3]
    yy, yz = quadric[a, 4] + quadric[b, 4], quadric[a, 5] + quadric[b, 5]
    y1, zz = quadric[a, 6] + quadric[b, 6], quadric[a, 7] + quadric[b, 7]
    z1, one = quadric[a, 8] + quadric[b, 8], quadric[a, 9] + quadric[b, 9]
    x = 0.5 * (position[a, 0] + position[b, 0])
    y = 0.5 * (position[a, 1] + position[b, 1])
    z = 0.5 * (position[a, 2] + position[b, 2])
    # Half the gradient there, and a step of Newton's, damped.
    gx, gy, gz = (
        xx * x + xy * y + xz * z + x1,
        xy * x + yy * y + yz * z + y1,
        xz * x + yz * y + zz * z + z1,
    )
    damping = _TOWARDS_MIDDLE * (xx + yy + zz)
    a0, b0, c0 = xx + damping, yy + damping, zz + damping
    i00, i01, i02 = b0 * c0 - yz * yz, xz * yz - xy * c0, xy * yz - xz * b0
    i11, i12, i22 = a0 * c0 - xz * xz, xy * xz - a0 * yz, a0 * b0 - xy * xy
    det = a0 * i00 + xy * i01 + xz * i02
    if det > 0:
        x -= (i00 * gx + i01 * gy + i02 * gz) / det
        y -= (i01 * gx + i11 * gy + i12 * gz) / det
        z -= (i02 * gx + i12 * gy + i22 * gz) / det
    cost = (
        x * (xx * x + 2 * (xy * y + xz * z + x1))
        + y * (yy * y + 2 * (yz * z + y1))
        + z * (zz * z + 2 * z1)
        + one
    )
    dx = position[a, 0] - position[b, 0]
    dy = position[a, 1] - position[b, 1]
    dz = position[a, 2] - position[b, 2]
    length = dx * dx + dy * dy + dz * dz
    return x, y, z, max(cost, 0.0) + _SHORT_FIRST * (xx + yy + zz) * length


@njit(cache=True, nogil=True, error_model="numpy")
def edge_cost(position, faces, quadric, fixed, f, k):
    """Cost of the edge that a corner stands for; infinite where it stands for none."""
    a, b = faces[f, k], faces[f, (k + 1) % 3]
    if a >= b or fixed[a] or fixed[b]:
        return np.inf
    return merged(position, quadric, a, b)[3]


@njit(cache=True, nogil=True, error_model="numpy")
def edge_costs(low, high, position, faces, quadric, fixed, cost):
    """Costs of the edges of faces ``low`` to ``high``."""
    for f in range(low, high):
        for k in range(3):
            cost[f, k] = edge_cost(position, faces, quadric, fixed, f, k)


@njit(cache=True, nogil=True, error_model="numpy")
def _rank(bits, limit, f, k):
    if bits[f, k] > limit:
        return NONE
    scattered = np.uint32(np.uint32(3 * f + k) * np.uint32(_SCATTER))
    return (np.int64(bits[f, k] >> _LEVEL) << 32) | np.int64(scattered)


@njit(cache=True, nogil=True, error_model="numpy")
def best_edges(low, high, first, corners, cost, limit, best):
    """The lowest rank of the edges at each of the vertices that cost no more than a limit.

    Ranks are in the order of costs, scattered among those that are about the same; no two edges
    have the same, and it tells the corner (:func:`ranked_corner`).
    """
    # Numbers that are not negative are in the order of their bits.
    bits, limit = cost.view(np.int32), limit.view(np.int32)[0]
    for v in range(low, high):
        found = NONE
        for i in range(first[v], first[v + 1]):
            f, k = corners[i] // 3, corners[i] % 3
            found = min(found, _rank(bits, limit, f, k), _rank(bits, limit, f, (k + 2) % 3))
        best[v] = found


@njit(cache=True, nogil=True, error_model="numpy")
def ranked_corner(rank):
    """The corner of an edge of some rank."""
    return np.int64(np.uint32(np.uint32(rank & 0xFFFFFFFF) * np.uint32(_GATHER)))


@njit(cache=True, nogil=True, error_model="numpy")
def match_vertices(low, high, faces, best, matched):
    """The best edges of vertices that are so for both of their ends; each has one at most."""
    for v in range(low, high):
        matched[v] = NONE
        if best[v] != NONE:
            c = ranked_corner(best[v])
            f, k = c // 3, c % 3
            if best[faces[f, k]] == best[faces[f, (k + 1) % 3]]:
                matched[v] = best[v]


@njit(cache=True, nogil=True, error_model="numpy")
def collapse(low, high, faces, first, corners, matched, fixed, position, quadric, cost, parent):
    """Merge the ends of matched edges that rank lower than all others near.

    No two of them have a face in common, nor does one have an end next to another's: each changes
    faces that no other looks at. Faces that two corners of are one are left for
    :func:`squeeze`.
    """
    for a in range(low, high):
        if matched[a] == NONE:
            continue
        c = ranked_corner(matched[a])
        f, k = c // 3, c % 3
        b = faces[f, (k + 1) % 3]
        if faces[f, k] != a or not (
            _is_first(faces, first, corners, matched, a)
            and _is_first(faces, first, corners, matched, b)
        ):
            continue
        x, y, z, _ = merged(position, quadric, a, b)
        if (
            _common(faces, first, corners, a, b) != 2
            or not _keeps_sides(faces, first, corners, position, a, b, x, y, z)
            or not _keeps_sides(faces, first, corners, position, b, a, x, y, z)
        ):
            cost[f, k] = np.inf
            continue
        position[a, 0], position[a, 1], position[a, 2] = x, y, z
        for n in range(10):
            quadric[a, n] += quadric[b, n]
        parent[b] = a
        for i in range(first[b], first[b + 1]):
            faces[corners[i] // 3, corners[i] % 3] = a
        _update_costs(position, faces, first, corners, quadric, fixed, cost, a)
        _update_costs(position, faces, first, corners, quadric, fixed, cost, b)


@njit(cache=True, nogil=True, error_model="numpy")
def _update_costs(position, faces, first, corners, quadric, fixed, cost, v):
    """Costs anew of the edges that were at a vertex, now that its place and its number changed."""
    for i in range(first[v], first[v + 1]):
        f, k = corners[i] // 3, corners[i] % 3
        cost[f, k] = edge_cost(position, faces, quadric, fixed, f, k)
        k = (k + 2) % 3
        cost[f, k] = edge_cost(position, faces, quadric, fixed, f, k)


@njit(cache=True, nogil=True, error_model="numpy")
def _is_first(faces, first, corners, matched, v):
    """Whether no vertex next to a matched one is matched by an edge that ranks lower."""
    for i in range(first[v], first[v + 1]):
        f, k = corners[i] // 3, corners[i] % 3
        if (
            matched[faces[f, (k + 1) % 3]] < matched[v]
            or matched[faces[f, (k + 2) % 3]] < matched[v]
        ):
            return False
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _common(faces, first, corners, a, b):
    """Neighbours that two vertices share."""
    count = 0
    for i in range(first[a], first[a + 1]):
        x = faces[corners[i] // 3, (corners[i] % 3 + 1) % 3]
        for j in range(first[b], first[b + 1]):
            count += faces[corners[j] // 3, (corners[j] % 3 + 1) % 3] == x
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _keeps_sides(faces, first, corners, position, v, other, x, y, z):
    """Whether no face at ``v`` without ``other`` turns over or becomes a needle if ``v`` moves."""
    for i in range(first[v], first[v + 1]):
        f, k = corners[i] // 3, corners[i] % 3
        b, c = faces[f, (k + 1) % 3], faces[f, (k + 2) % 3]
        if b == other or c == other:
            continue
        ox, oy, oz = _normal(position, v, b, c)
        ux, uy, uz = position[b, 0] - x, position[b, 1] - y, position[b, 2] - z
        vx, vy, vz = position[c, 0] - x, position[c, 1] - y, position[c, 2] - z
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        old, new = ox * ox + oy * oy + oz * oz, nx * nx + ny * ny + nz * nz
        turn = ox * nx + oy * ny + oz * nz
        if not (turn > 0 and turn * turn > _LEAST_COSINE**2 * old * new):
            return False
        wx, wy, wz = ux - vx, uy - vy, uz - vz
        edges = (
            ux * ux + uy * uy + uz * uz
            + vx * vx + vy * vy + vz * vz
            + wx * wx + wy * wy + wz * wz
        )  # fmt: skip
        if new < (_FLATTEST * edges) ** 2:
            return False
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def squeeze(faces, cost, left_faces, left_cost):
    """Write the faces with three different corners, with their edges' costs; how many these are."""
    left = 0
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if a == b or b == c or c == a:
            continue
        left_faces[left, 0], left_faces[left, 1], left_faces[left, 2] = a, b, c
        for k in range(3):
            left_cost[left, k] = cost[f, k]
        left += 1
    return left
