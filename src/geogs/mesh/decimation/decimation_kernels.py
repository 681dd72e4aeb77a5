"""The loops of parallel edge collapse, and of distances to triangles, in numba.

Corner 3 f + k is that of face f at its k-th vertex, and stands for the edge from there to the next
vertex of the face. Of the two corners of an edge the one at the lower vertex stands for it.
Functions take corners and vertices as 64-bit integers, so that each is compiled once.
"""

import math

import numpy as np
from numba import njit

NONE = 2**62
"""Rank of no edge."""
_TOWARDS_MIDDLE = 1e-3
_FLATTEST = 0.01
_SHORT_FIRST = 1e-4
"""A hundredth, squared: an edge costs as much as if its vertices moved by that fraction of its
length, so in planes short edges come first."""
_LEAST_COSINE = 0.2
_SCATTER, _GATHER = 2654435769, 340573321
"""Their product is 1 modulo 2^32."""
_LEVEL = 21
"""Bits of a cost that ranks leave out; the others resolve costs to a quarter or better."""


@njit(cache=True, nogil=True, error_model="numpy")
def rings(faces, count):
    """Index of each of ``count`` vertices' first corner in a list of corners, and that list."""
    first = np.zeros(count + 1, np.int32)
    for c in range(len(faces)):
        first[faces[c] + 1] += 1
    for v in range(count):
        first[v + 1] += first[v]
    place = first[:-1].copy()
    corners = np.empty(len(faces), np.int32)
    for c in range(len(faces)):
        corners[place[faces[c]]] = c
        place[faces[c]] += 1
    return first, corners


@njit(cache=True, nogil=True, error_model="numpy")
def _after(faces, corner):
    """The vertex that follows in the face of a corner."""
    return np.int64(faces[corner - 2 if corner % 3 == 2 else corner + 1])


@njit(cache=True, nogil=True, error_model="numpy")
def _before(faces, corner):
    """The vertex that comes before in the face of a corner."""
    return np.int64(faces[corner + 2 if corner % 3 == 0 else corner - 1])


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
            c = np.int64(corners[i])
            _add_plane(position, faces, c - c % 3, quadric, v)
            after, before = _after(faces, c), _before(faces, c)
            twins = 0
            for j in range(first[v], first[v + 1]):
                near = np.int64(corners[j])
                next_one = _after(faces, near)
                last_one = _before(faces, near)
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
def _add_plane(position, faces, c, quadric, v):
    a = np.int64(faces[c])
    nx, ny, nz = _normal(position, a, _after(faces, c), _before(faces, c))
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
    """Position of two merged vertices: nearest to all planes of both, in the middle where these
    leave it open. Also the squared distance to these, summed by area, and the area."""
    xx, xy = quadric[a, 0] + quadric[b, 0], quadric[a, 1] + quadric[b, 1]
    xz, x1 = quadric[a, 2] + quadric[b, 2], quadric[a, 3] + quadric[b, 3]
    yy, yz = quadric[a, 4] + quadric[b, 4], quadric[a, 5] + quadric[b, 5]
    y1 = quadric[a, 6] + quadric[b, 6]
    zz = quadric[a, 7] + quadric[b, 7]
    z1 = quadric[a, 8] + quadric[b, 8]
    one = quadric[a, 9] + quadric[b, 9]
    x = 0.5 * (position[a, 0] + position[b, 0])
    y = 0.5 * (position[a, 1] + position[b, 1])
    z = 0.5 * (position[a, 2] + position[b, 2])
    # Half the gradient there, and a damped Newton step.
    gx, gy, gz = (
        xx * x + xy * y + xz * z + x1,
        xy * x + yy * y + yz * z + y1,
        xz * x + yz * y + zz * z + z1,
    )
    damping = _TOWARDS_MIDDLE * (xx + yy + zz)
    a0 = xx + damping
    b0 = yy + damping
    c0 = zz + damping
    i00, i01, i02 = b0 * c0 - yz * yz, xz * yz - xy * c0, xy * yz - xz * b0
    i11 = a0 * c0 - xz * xz
    i12 = xy * xz - a0 * yz
    i22 = a0 * b0 - xy * xy
    det = a0 * i00 + xy * i01 + xz * i02
    if det > 0:
        step = 1 / det
        x -= (i00 * gx + i01 * gy + i02 * gz) * step
        y -= (i01 * gx + i11 * gy + i12 * gz) * step
        z -= (i02 * gx + i12 * gy + i22 * gz) * step
    error = (
        x * (xx * x + 2 * (xy * y + xz * z + x1))
        + y * (yy * y + 2 * (yz * z + y1))
        + z * (zz * z + 2 * z1)
        + one
    )
    return x, y, z, max(error, 0.0), xx + yy + zz


@njit(cache=True, nogil=True, error_model="numpy")
def edge_cost(position, faces, quadric, fixed, bound, corner):
    """Cost of the edge that a corner stands for; infinite if it stands for none or costs, by area,
    more than the square of a bound."""
    a = np.int64(faces[corner])
    b = _after(faces, corner)
    if a >= b or fixed[a] or fixed[b]:
        return np.inf
    _, _, _, error, area = merged(position, quadric, a, b)
    dx = position[a, 0] - position[b, 0]
    dy = position[a, 1] - position[b, 1]
    dz = position[a, 2] - position[b, 2]
    cost = error + _SHORT_FIRST * area * (dx * dx + dy * dy + dz * dz)
    return cost if cost <= bound * bound * area else np.inf


@njit(cache=True, nogil=True, error_model="numpy")
def edge_costs(low, high, position, faces, quadric, fixed, bound, cost):
    """Costs of the edges of corners ``low`` to ``high``."""
    for c in range(low, high):
        cost[c] = edge_cost(position, faces, quadric, fixed, bound[0], c)


@njit(cache=True, nogil=True, error_model="numpy")
def _rank(bits, limit, corner):
    if bits[corner] > limit:
        return NONE
    scattered = np.uint32(np.uint32(corner) * np.uint32(_SCATTER))
    return (np.int64(bits[corner] >> _LEVEL) << 32) | np.int64(scattered)


@njit(cache=True, nogil=True, error_model="numpy")
def best_edges(low, high, first, corners, cost, limit, best):
    """The lowest rank, at each of the vertices, of the edges that cost no more than a limit.

    Ranks are in the order of costs, scattered among similar costs. Every edge has a rank of its
    own, from which the corner follows (:func:`ranked_corner`).
    """
    # Non-negative numbers are in the order of their bits.
    bits = cost.view(np.int32)
    limit = limit.view(np.int32)[0]
    for v in range(low, high):
        found = NONE
        for i in range(first[v], first[v + 1]):
            c = np.int64(corners[i])
            coming = c + 2 if c % 3 == 0 else c - 1
            found = min(found, _rank(bits, limit, c), _rank(bits, limit, coming))
        best[v] = found


@njit(cache=True, nogil=True, error_model="numpy")
def ranked_corner(rank):
    """The corner of an edge of some rank."""
    return np.int64(np.uint32(np.uint32(rank & 0xFFFFFFFF) * np.uint32(_GATHER)))


@njit(cache=True, nogil=True, error_model="numpy")
def match_vertices(low, high, faces, best, matched):
    """Match vertices by edges that are the best of both of their ends; at most one a vertex."""
    for v in range(low, high):
        matched[v] = NONE
        if best[v] != NONE:
            c = ranked_corner(best[v])
            if best[faces[c]] == best[_after(faces, c)]:
                matched[v] = best[v]


@njit(cache=True, nogil=True, error_model="numpy")
def collapse(
    low, high, faces, first, corners, matched, fixed, bound, position, quadric, cost, parent
):
    """Merge the ends of matched edges that rank lower than all others near.

    No two of them have a face in common, nor does one have an end next to another's: each changes
    faces that no other reads. Faces of which two corners are the same are left for
    :func:`squeeze`.
    """
    for a in range(low, high):
        if matched[a] == NONE:
            continue
        c = ranked_corner(matched[a])
        b = _after(faces, c)
        if faces[c] != a or not (
            _is_first(faces, first, corners, matched, a)
            and _is_first(faces, first, corners, matched, b)
        ):
            continue
        x, y, z, _, _ = merged(position, quadric, a, b)
        if (
            _common(faces, first, corners, a, b) != 2
            or not _keeps_sides(faces, first, corners, position, a, b, x, y, z)
            or not _keeps_sides(faces, first, corners, position, b, a, x, y, z)
        ):
            cost[c] = np.inf
            continue
        position[a, 0] = x
        position[a, 1] = y
        position[a, 2] = z
        for n in range(10):
            quadric[a, n] += quadric[b, n]
        parent[b] = a
        for i in range(first[b], first[b + 1]):
            faces[corners[i]] = a
        _update_costs(position, faces, first, corners, quadric, fixed, bound, cost, a)
        _update_costs(position, faces, first, corners, quadric, fixed, bound, cost, b)


@njit(cache=True, nogil=True, error_model="numpy")
def _update_costs(position, faces, first, corners, quadric, fixed, bound, cost, v):
    """Update the costs of the edges that were at a vertex, whose position and index changed."""
    for i in range(first[v], first[v + 1]):
        leaving = np.int64(corners[i])
        coming = leaving + 2 if leaving % 3 == 0 else leaving - 1
        cost[leaving] = edge_cost(position, faces, quadric, fixed, bound[0], leaving)
        cost[coming] = edge_cost(position, faces, quadric, fixed, bound[0], coming)


@njit(cache=True, nogil=True, error_model="numpy")
def _is_first(faces, first, corners, matched, v):
    """Whether no vertex next to a matched one is matched by an edge that ranks lower."""
    for i in range(first[v], first[v + 1]):
        c = np.int64(corners[i])
        if matched[_after(faces, c)] < matched[v] or matched[_before(faces, c)] < matched[v]:
            return False
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _common(faces, first, corners, a, b):
    """Number of neighbours that two vertices share."""
    count = 0
    for i in range(first[a], first[a + 1]):
        x = _after(faces, np.int64(corners[i]))
        for j in range(first[b], first[b + 1]):
            count += _after(faces, np.int64(corners[j])) == x
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _keeps_sides(faces, first, corners, position, v, other, x, y, z):
    """Whether no face at ``v`` without ``other`` turns over or becomes a needle if ``v`` moves."""
    for i in range(first[v], first[v + 1]):
        corner = np.int64(corners[i])
        b = _after(faces, corner)
        c = _before(faces, corner)
        if b == other or c == other:
            continue
        ox, oy, oz = _normal(position, v, b, c)
        ux, uy, uz = position[b, 0] - x, position[b, 1] - y, position[b, 2] - z
        vx, vy, vz = position[c, 0] - x, position[c, 1] - y, position[c, 2] - z
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        old = ox * ox + oy * oy + oz * oz
        new = nx * nx + ny * ny + nz * nz
        turn = ox * nx + oy * ny + oz * nz
        if not (turn > 0 and turn * turn > _LEAST_COSINE**2 * old * new):
            return False
        wx, wy, wz = ux - vx, uy - vy, uz - vz
        edges = (
            ux * ux + uy * uy + uz * uz + vx * vx + vy * vy + vz * vz + wx * wx + wy * wy + wz * wz
        )
        if new < (_FLATTEST * edges) ** 2:
            return False
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def squeeze(faces, cost, left_faces, left_cost):
    """Write the faces with three different corners, with their edges' costs; return the number of
    their corners."""
    left = 0
    for f in range(0, len(faces), 3):
        a, b, c = faces[f], faces[f + 1], faces[f + 2]
        if a == b or b == c or c == a:
            continue
        for k in range(3):
            left_faces[left + k] = faces[f + k]
            left_cost[left + k] = cost[f + k]
        left += 3
    return left


@njit(cache=True, nogil=True, error_model="numpy")
def triangle_distance(point, triangle):
    """Distance of a point to a triangle (its corners in rows).

    It is that to the plane where the foot of the perpendicular lies inside, else that to the
    nearest of the three edges.
    """
    ux, uy, uz = _difference(triangle[1], triangle[0])
    vx, vy, vz = _difference(triangle[2], triangle[0])
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    inside = length > 0
    nearest = np.inf
    for corner in range(3):
        start = triangle[corner]
        ex, ey, ez = _difference(triangle[(corner + 1) % 3], start)
        rx, ry, rz = _difference(point, start)
        turn = (ey * rz - ez * ry) * nx + (ez * rx - ex * rz) * ny + (ex * ry - ey * rx) * nz
        inside = inside and turn >= 0
        squared = ex * ex + ey * ey + ez * ez
        fraction = (rx * ex + ry * ey + rz * ez) / squared if squared > 0 else 0.0
        fraction = min(max(fraction, 0.0), 1.0)
        dx, dy, dz = rx - fraction * ex, ry - fraction * ey, rz - fraction * ez
        nearest = min(nearest, math.sqrt(dx * dx + dy * dy + dz * dz))
    if not inside:
        return nearest
    rx, ry, rz = _difference(point, triangle[0])
    return abs(rx * nx + ry * ny + rz * nz) / length


@njit(cache=True, nogil=True, error_model="numpy")
def _difference(a, b):
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@njit(cache=True, nogil=True, error_model="numpy")
def nearest_faces(points, near, first, around, corners):
    """Distance of each point to the nearest of the faces around some vertices of its own.

    points (k, 3); near (k, j): the vertices; corners (m, 3, 3): of the faces, float64.
    """
    found = np.full(len(points), np.inf)
    for k in range(len(points)):
        for vertex in near[k]:
            for place in range(first[vertex], first[vertex + 1]):
                found[k] = min(found[k], triangle_distance(points[k], corners[around[place]]))
    return found
