"""Visibility of the ambient light and of each light from every cell of a scene, compiled."""

import numpy as np
from numba import njit

from geogs_synth.raycast.solid_kernels import COMPILED, crossing

_ROUNDING = 1e-6
"""Metres by which bounding balls are enlarged."""


@njit(**COMPILED)
def _near_segment(centre, radius, px, py, pz, dx, dy, dz, margin, near):
    """Find the solids whose bounding ball comes within ``margin`` of the segment from p to p + d.

    Their indices go to ``near``; returns their number. No ray that stays within the margin hits
    another.
    """
    count, square = 0, dx * dx + dy * dy + dz * dz
    for i in range(len(radius)):
        x, y, z = centre[i, 0] - px, centre[i, 1] - py, centre[i, 2] - pz
        along = 0.0
        if square > 0.0:
            along = min(max((x * dx + y * dy + z * dz) / square, 0.0), 1.0)
        x, y, z = x - along * dx, y - along * dy, z - along * dz
        reach = radius[i] + margin + _ROUNDING
        if x * x + y * y + z * z <= reach * reach:
            near[count] = i
            count += 1
    return count


@njit(**COMPILED)
def _blocked(
    kind, half, rotation, centre, radius, near, count, px, py, pz, dx, dy, dz, reach
):  # fmt: skip
    """Whether any of the first ``count`` solids of ``near`` lies within ``reach`` along the unit
    direction d from p."""
    for k in range(count):
        i = near[k]
        t, _ = crossing(
            kind[i], half[i], rotation[i], centre[i], radius[i],
            px, py, pz, dx, dy, dz, reach, False,
        )  # fmt: skip
        if t < reach:
            return True
    return False


@njit(**COMPILED)
def visibility_slices(
    kind, half, rotation, centre, radius, lights, sphere, ambient_reach, voxel, first, last, volume
):
    """Fills slices [first, last) of ``volume`` (nz, ny, nx, 1 + lights).

    Channel 0 is ambient openness: twice the fraction of directions free of solids within
    ``ambient_reach``, at most 1, since a wall hides half of them. The others are the seen fraction
    of each light, a ball (x, y, z, radius), sampled at the points ``sphere`` of the unit sphere.
    """
    samples, near = len(sphere), np.empty(len(kind), np.int64)
    for z in range(first, last):
        for y in range(volume.shape[1]):
            for x in range(volume.shape[2]):
                px, py, pz = (x + 0.5) * voxel, (y + 0.5) * voxel, (z + 0.5) * voxel
                free = 0
                count = _near_segment(
                    centre, radius, px, py, pz, 0.0, 0.0, 0.0, ambient_reach, near
                )
                for s in range(samples):
                    dx, dy, dz = sphere[s, 0], sphere[s, 1], sphere[s, 2]
                    free += not _blocked(
                        kind, half, rotation, centre, radius, near, count, px, py, pz,
                        dx, dy, dz, ambient_reach,
                    )  # fmt: skip
                volume[z, y, x, 0] = min(1.0, 2.0 * free / samples)
                for i in range(len(lights)):
                    free = 0
                    count = _near_segment(
                        centre, radius, px, py, pz, lights[i, 0] - px, lights[i, 1] - py,
                        lights[i, 2] - pz, lights[i, 3], near,
                    )  # fmt: skip
                    # Every other direction is enough for a light and still spread evenly.
                    for s in range(0, samples, 2):
                        dx = lights[i, 0] + lights[i, 3] * sphere[s, 0] - px
                        dy = lights[i, 1] + lights[i, 3] * sphere[s, 1] - py
                        dz = lights[i, 2] + lights[i, 3] * sphere[s, 2] - pz
                        reach = np.sqrt(dx * dx + dy * dy + dz * dz)
                        free += not _blocked(
                            kind, half, rotation, centre, radius, near, count, px, py, pz,
                            dx / reach, dy / reach, dz / reach, reach,
                        )  # fmt: skip
                    volume[z, y, x, 1 + i] = 2.0 * free / samples
