"""Rays against single solids and rays against many, compiled; solids are those of solids.py.

Rays are o + t d. A unit d makes t a distance, a d of unit z in the camera's frame makes it a depth.
"""

import math

import numpy as np
from numba import njit

from geogs_synth.scene.solids import BOX, FRUSTUM

COMPILED = {"cache": True, "nogil": True, "error_model": "numpy"}
"""Options of all kernels."""
_NEAR = 1e-6


@njit(inline="always", **COMPILED)
def _hit_box(ox, oy, oz, dx, dy, dz, hx, hy, hz):
    """Depth and face of the first crossing in front (slab method); inf if missed."""
    near, far = -np.inf, np.inf
    near_face, far_face = 0, 0
    for axis in range(3):
        if axis == 0:
            o, d, h = ox, dx, hx
        elif axis == 1:
            o, d, h = oy, dy, hy
        else:
            o, d, h = oz, dz, hz
        if d == 0.0:
            if abs(o) > h:
                return np.inf, 0
            continue
        inverse = 1.0 / d
        # The ray enters through the side that faces it.
        enter_side = 2 * axis + (1 if d < 0.0 else 0)
        enter = (-o - h if d > 0.0 else h - o) * inverse
        leave = (h - o if d > 0.0 else -o - h) * inverse
        if enter > near:
            near, near_face = enter, enter_side
        if leave < far:
            far, far_face = leave, enter_side ^ 1
    if near > far or far < _NEAR:
        return np.inf, 0
    if near > _NEAR:
        return near, near_face
    return far, far_face


@njit(inline="always", **COMPILED)
def _hit_frustum(ox, oy, oz, dx, dy, dz, r0, r1, h):
    """First crossing of the side x^2 + y^2 = (m + k z)^2 or of a cap."""
    best, face = np.inf, 0
    middle, slope = 0.5 * (r0 + r1), 0.5 * (r1 - r0) / h
    reach = middle + slope * oz
    a = dx * dx + dy * dy - slope * slope * dz * dz
    b = ox * dx + oy * dy - slope * dz * reach
    c = ox * ox + oy * oy - reach * reach
    disc = b * b - a * c
    if disc >= 0.0 and a != 0.0:
        root = math.sqrt(disc)
        for sign in (-1.0, 1.0):
            t = (-b + sign * root) / a
            if _NEAR < t < best and abs(oz + t * dz) <= h and reach + slope * t * dz >= 0.0:
                best = t
    if dz != 0.0:
        for side in range(2):
            t = ((h if side else -h) - oz) / dz
            x, y, radius = ox + t * dx, oy + t * dy, (r1 if side else r0)
            if _NEAR < t < best and x * x + y * y <= radius * radius:
                best, face = t, 4 + side
    return best, face


@njit(inline="always", **COMPILED)
def _hit_ellipsoid(ox, oy, oz, dx, dy, dz, rx, ry, rz):
    """First crossing of the unit sphere after scaling by the radii."""
    ox, oy, oz, dx, dy, dz = ox / rx, oy / ry, oz / rz, dx / rx, dy / ry, dz / rz
    a = dx * dx + dy * dy + dz * dz
    b = ox * dx + oy * dy + oz * dz
    disc = b * b - a * (ox * ox + oy * oy + oz * oz - 1.0)
    if disc < 0.0:
        return np.inf, 0
    root = math.sqrt(disc)
    t = (-b - root) / a
    if t < _NEAR:
        t = (-b + root) / a
    return (t, 0) if t > _NEAR else (np.inf, 0)


@njit(**COMPILED)
def hit(kind, half, ox, oy, oz, dx, dy, dz):
    """Distance and face of the first crossing of a local ray with one solid; inf if missed."""
    if kind == BOX:
        return _hit_box(ox, oy, oz, dx, dy, dz, half[0], half[1], half[2])
    if kind == FRUSTUM:
        return _hit_frustum(ox, oy, oz, dx, dy, dz, half[0], half[1], half[2])
    return _hit_ellipsoid(ox, oy, oz, dx, dy, dz, half[0], half[1], half[2])


@njit(**COMPILED)
def outward_normal(kind, half, face, px, py, pz):
    """Outward unit normal at a local surface point."""
    if kind == BOX or face >= 4:
        sign = 1.0 if face & 1 else -1.0
        axis = face >> 1
        return (sign if axis == 0 else 0.0, sign if axis == 1 else 0.0, sign if axis == 2 else 0.0)
    if kind == FRUSTUM:
        slope = 0.5 * (half[1] - half[0]) / half[2]
        nx, ny = px, py
        nz = -slope * math.sqrt(px * px + py * py)
    else:
        nx, ny, nz = px / half[0] ** 2, py / half[1] ** 2, pz / half[2] ** 2
    scale = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz)
    return nx * scale, ny * scale, nz * scale


@njit(**COMPILED)
def crossing(kind, half, rotation, centre, radius, px, py, pz, dx, dy, dz, reach, from_outside):
    """Distance and face at which the ray from p along the unit d first crosses a solid; inf if not.

    Distances beyond ``reach`` may be inf, too. ``radius`` is that of the ball around the solid.
    With ``from_outside`` rays that start in a solid do not hit it.
    """
    x, y, z = px - centre[0], py - centre[1], pz - centre[2]
    # Most solids are ruled out by their bounding sphere's distance from the segment.
    along = min(max(-(x * dx + y * dy + z * dz), 0.0), reach)
    sx, sy, sz = x + along * dx, y + along * dy, z + along * dz
    if sx * sx + sy * sy + sz * sz > radius * radius:
        return np.inf, 0
    r = rotation
    ox = r[0, 0] * x + r[1, 0] * y + r[2, 0] * z
    oy = r[0, 1] * x + r[1, 1] * y + r[2, 1] * z
    oz = r[0, 2] * x + r[1, 2] * y + r[2, 2] * z
    if from_outside and _inside(kind, half, ox, oy, oz):
        return np.inf, 0
    lx = r[0, 0] * dx + r[1, 0] * dy + r[2, 0] * dz
    ly = r[0, 1] * dx + r[1, 1] * dy + r[2, 1] * dz
    lz = r[0, 2] * dx + r[1, 2] * dy + r[2, 2] * dz
    return hit(kind, half, ox, oy, oz, lx, ly, lz)


@njit(**COMPILED)
def _inside(kind, half, x, y, z):
    """Whether a local point lies in a solid."""
    if kind == BOX:
        return abs(x) < half[0] and abs(y) < half[1] and abs(z) < half[2]
    if kind == FRUSTUM:
        wide = 0.5 * (half[0] + half[1]) + 0.5 * (half[1] - half[0]) / half[2] * z
        return abs(z) < half[2] and x * x + y * y < wide * wide
    x, y, z = x / half[0], y / half[1], z / half[2]
    return x * x + y * y + z * z < 1.0


@njit(**COMPILED)
def closest_hits(kind, half, rotation, centre, radius, origin, direction, t, solid):
    """Find the first solid that each ray hits before ``t``; update ``t`` and ``solid`` there.

    Solids are only hit from outside; those of a negative kind not at all.
    """
    for ray in range(len(t)):
        p, d = origin[ray], direction[ray]
        length = math.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
        dx, dy, dz, best = d[0] / length, d[1] / length, d[2] / length, t[ray] * length
        for i in range(len(kind)):
            if kind[i] < 0:
                continue
            there, _ = crossing(
                kind[i], half[i], rotation[i], centre[i], radius[i],
                p[0], p[1], p[2], dx, dy, dz, best, True,
            )  # fmt: skip
            if there < best:
                best = there
                solid[ray] = i
                t[ray] = best / length
