"""Rays against solids, and the light that reaches the cells of a scene, compiled.

Rays are o + t d. A unit d makes t a distance, a d of unit z in the camera's frame makes it a depth.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from geogs_synth.scene.solids import BOX, FRUSTUM

COMPILED = {"cache": True, "nogil": True, "error_model": "numpy"}
"""Options of all kernels."""
_NEAR = 1e-6


class BoundedSolids(NamedTuple):
    """Solids (those of ``scene.solids``) and the radii of the balls around them."""

    kind: np.ndarray  # n
    half: np.ndarray  # n 3
    rotation: np.ndarray  # n 3 3, local to world
    centre: np.ndarray  # n 3
    radius: np.ndarray  # n


@njit(inline="always", **COMPILED)
def _hit_box(ox, oy, oz, dx, dy, dz, hx, hy, hz):
    """Depth and face of the first crossing in front (slab method); inf if missed."""
    near, far = -np.inf, np.inf
    near_face = 0
    far_face = 0
    for axis, (o, d, h) in enumerate(((ox, dx, hx), (oy, dy, hy), (oz, dz, hz))):
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
            near = enter
            near_face = enter_side
        if leave < far:
            far = leave
            far_face = enter_side ^ 1
    if near > far or far < _NEAR:
        return np.inf, 0
    if near > _NEAR:
        return near, near_face
    return far, far_face


@njit(inline="always", **COMPILED)
def _hit_frustum(ox, oy, oz, dx, dy, dz, r0, r1, h):
    """First crossing of the side x^2 + y^2 = (m + k z)^2 or of a cap."""
    best = np.inf
    face = 0
    middle = 0.5 * (r0 + r1)
    slope = 0.5 * (r1 - r0) / h
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
            x = ox + t * dx
            y = oy + t * dy
            radius = r1 if side else r0
            if _NEAR < t < best and x * x + y * y <= radius * radius:
                best = t
                face = 4 + side
    return best, face


@njit(inline="always", **COMPILED)
def _hit_ellipsoid(ox, oy, oz, dx, dy, dz, rx, ry, rz):
    """First crossing of the unit sphere after scaling by the radii."""
    ox = ox / rx
    oy = oy / ry
    oz = oz / rz
    dx = dx / rx
    dy = dy / ry
    dz = dz / rz
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
def crossing(solids, i, px, py, pz, dx, dy, dz, reach, from_outside):
    """Distance at which the ray from p along the unit d first crosses solid i; inf if not.

    Distances beyond ``reach`` may be inf, too. With ``from_outside`` rays that start in a solid do
    not hit it.
    """
    centre = solids.centre[i]
    half = solids.half[i]
    kind = solids.kind[i]
    x, y, z = px - centre[0], py - centre[1], pz - centre[2]
    # Most solids are ruled out by their bounding sphere's distance from the segment.
    along = min(max(-(x * dx + y * dy + z * dz), 0.0), reach)
    sx, sy, sz = x + along * dx, y + along * dy, z + along * dz
    if sx * sx + sy * sy + sz * sz > solids.radius[i] * solids.radius[i]:
        return np.inf
    r = solids.rotation[i]
    ox = r[0, 0] * x + r[1, 0] * y + r[2, 0] * z
    oy = r[0, 1] * x + r[1, 1] * y + r[2, 1] * z
    oz = r[0, 2] * x + r[1, 2] * y + r[2, 2] * z
    if from_outside and _inside(kind, half, ox, oy, oz):
        return np.inf
    lx = r[0, 0] * dx + r[1, 0] * dy + r[2, 0] * dz
    ly = r[0, 1] * dx + r[1, 1] * dy + r[2, 1] * dz
    lz = r[0, 2] * dx + r[1, 2] * dy + r[2, 2] * dz
    return hit(kind, half, ox, oy, oz, lx, ly, lz)[0]


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
def closest_hits(solids, origin, direction, t, solid):
    """Find the first solid that each ray hits before ``t``; update ``t`` and ``solid`` there.

    Solids are only hit from outside; those of a negative kind not at all.
    """
    for ray in range(len(t)):
        p = origin[ray]
        d = direction[ray]
        length = math.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
        dx = d[0] / length
        dy = d[1] / length
        dz = d[2] / length
        best = t[ray] * length
        for i in range(len(solids.kind)):
            if solids.kind[i] < 0:
                continue
            there = crossing(solids, i, p[0], p[1], p[2], dx, dy, dz, best, True)
            if there < best:
                best = there
                solid[ray] = i
                t[ray] = best / length


@njit(**COMPILED)
def _near_segment(solids, px, py, pz, dx, dy, dz, margin, near):
    """Find the solids whose bounding ball comes within ``margin`` of the segment from p to p + d.

    Their indices go to ``near``; returns their number. No ray that stays within the margin hits
    another.
    """
    count = 0
    square = dx * dx + dy * dy + dz * dz
    for i in range(len(solids.kind)):
        centre = solids.centre[i]
        x, y, z = centre[0] - px, centre[1] - py, centre[2] - pz
        along = 0.0
        if square > 0.0:
            along = min(max((x * dx + y * dy + z * dz) / square, 0.0), 1.0)
        x, y, z = x - along * dx, y - along * dy, z - along * dz
        reach = solids.radius[i] + margin + 1e-6  # more than what is rounded
        if x * x + y * y + z * z <= reach * reach:
            near[count] = i
            count += 1
    return count


@njit(**COMPILED)
def _blocked(solids, near, px, py, pz, dx, dy, dz, reach):
    """Whether a solid of ``near`` lies within ``reach`` along the unit direction d from p."""
    for i in near:
        t = crossing(solids, i, px, py, pz, dx, dy, dz, reach, False)
        if t < reach:
            return True
    return False


@njit(**COMPILED)
def visibility_slices(solids, lights, sphere, ambient_reach, voxel, first, last, volume):
    """Fills slices [first, last) of ``volume`` (nz, ny, nx, 1 + lights).

    Channel 0 is ambient openness: twice the fraction of directions free of solids within
    ``ambient_reach``, at most 1, since a wall hides half of them. The others are the seen fraction
    of each light, a ball (x, y, z, radius), sampled at the points ``sphere`` of the unit sphere.
    """
    samples = len(sphere)
    near = np.empty(len(solids.kind), np.int64)
    for z in range(first, last):
        for y in range(volume.shape[1]):
            for x in range(volume.shape[2]):
                px, py, pz = (x + 0.5) * voxel, (y + 0.5) * voxel, (z + 0.5) * voxel
                free = 0
                count = _near_segment(solids, px, py, pz, 0.0, 0.0, 0.0, ambient_reach, near)
                for s in range(samples):
                    dx, dy, dz = sphere[s, 0], sphere[s, 1], sphere[s, 2]
                    free += not _blocked(
                        solids, near[:count], px, py, pz, dx, dy, dz, ambient_reach
                    )
                volume[z, y, x, 0] = min(1.0, 2.0 * free / samples)
                for i in range(len(lights)):
                    lx, ly, lz = lights[i, 0] - px, lights[i, 1] - py, lights[i, 2] - pz
                    size = lights[i, 3]
                    free = 0
                    count = _near_segment(solids, px, py, pz, lx, ly, lz, size, near)
                    # Every other direction is enough for a light and still spread evenly.
                    for s in range(0, samples, 2):
                        dx = lights[i, 0] + size * sphere[s, 0] - px
                        dy = lights[i, 1] + size * sphere[s, 1] - py
                        dz = lights[i, 2] + size * sphere[s, 2] - pz
                        reach = np.sqrt(dx * dx + dy * dy + dz * dz)
                        dx, dy, dz = dx / reach, dy / reach, dz / reach
                        free += not _blocked(solids, near[:count], px, py, pz, dx, dy, dz, reach)
                    volume[z, y, x, 1 + i] = 2.0 * free / samples
