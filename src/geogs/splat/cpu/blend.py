"""Compositing the disks of each tile, front to back."""

import numba
import numpy as np

from geogs.kernel_parts import inlined
from geogs.splat.cpu import layout as at
from geogs.splat.cpu.layout import (
    HALF,
    LANES,
    MAX_ALPHA,
    MIN_ALPHA,
    MIN_HIT_RATIO,
    MIN_TRANSMITTANCE,
    ONE,
    PER_PIXEL,
    PLANE,
    TILE_HEIGHT,
    TILE_PIXELS,
    TILE_WIDTH,
    TWO,
    ZERO,
    exp_minus,
)

_PART = inlined(PER_PIXEL)
# State planes. Offsets are unsigned, so that the compiler need not handle negative indices.
(
    _X, _Y, _LIGHT, _MOMENT, _NORMAL_X, _NORMAL_Y, _NORMAL_Z, _DISTORTION, _MEDIAN, _LAST,
    _ALPHA, _DEPTH,
) = (np.uint64(k * PLANE) for k in range(12))  # fmt: skip
BLEND_PLANES = 12
_RUN = np.uint64(LANES)
_RUNS = TILE_PIXELS // LANES
CHECK_EVERY = 16
"""List entries after which the runs worth visiting are determined again."""


@numba.njit(**_PART)
def reference_depth(records, lists, first, last):
    """Origin of the depths in a tile's sums, to keep their digits: the middle disk's depth."""
    return ONE / records[lists[(first + last) // 2], at.WC]


@numba.njit(**_PART)
def common_runs(runs, k, first_run, last_run):
    """The runs first..last that list entry k reaches, within first_run..last_run."""
    first = max(runs[k, 0], first_run)
    return np.uint64(first), np.uint64(max(min(runs[k, 1], last_run), first))


@numba.njit(**_PART)
def blend_disk(state, first, last, r, rank, z_reference, inverse_near):
    """Blend one disk into the runs first..last of a tile; returns the sum of its weights.

    A pixel's light is the transmittance, and becomes negative when blending stops. There are two
    loops, because in one the long chain of dependent results of each pixel would stall the
    processor.
    """
    mx = r[at.MX]
    my = r[at.MY]
    opacity = r[at.OPACITY]
    wc = r[at.WC]
    ux = r[at.UX]
    uy = r[at.UY]
    vx = r[at.VX]
    vy = r[at.VY]
    wx = r[at.WX]
    wy = r[at.WY]
    nx, ny, nz = r[at.NX], r[at.NY], r[at.NZ]
    nearest = r[at.Z_NEAREST]
    furthest = r[at.Z_FURTHEST]
    least = wc * MIN_HIT_RATIO
    for j in range(first * _RUN, last * _RUN):
        dx, dy = state[_X + j] - mx, state[_Y + j] - my
        w = wx * dx + wy * dy + wc
        bounded = min(max(w, least), inverse_near)
        z = ONE / bounded
        u, v = z * (ux * dx + uy * dy), z * (vx * dx + vy * dy)
        rho3, rho2 = u * u + v * v, dx * dx + dy * dy
        on_plane = (bounded == w) & (rho3 <= rho2)
        state[_DEPTH + j] = z if on_plane else min(max(z, nearest), furthest)
        state[_ALPHA + j] = min(opacity * exp_minus(rho3 if on_plane else rho2), MAX_ALPHA)
    shown = ZERO
    for j in range(first * _RUN, last * _RUN):
        a = state[_ALPHA + j]
        z = state[_DEPTH + j]
        light = state[_LIGHT + j]
        weight = light * a
        left = light - weight
        hit = a >= MIN_ALPHA
        blended = hit & (left >= MIN_TRANSMITTANCE)
        weight = weight if blended else ZERO
        zc = z - z_reference
        moment = state[_MOMENT + j]
        state[_DISTORTION + j] += weight * abs(zc * (ONE - light) - moment)
        state[_MOMENT + j] = moment + weight * zc
        state[_NORMAL_X + j] += weight * nx
        state[_NORMAL_Y + j] += weight * ny
        state[_NORMAL_Z + j] += weight * nz
        state[_MEDIAN + j] = z if blended & (light > HALF) else state[_MEDIAN + j]
        state[_LAST + j] = rank if blended else state[_LAST + j]
        stopped = -abs(light) if hit else light
        state[_LIGHT + j] = left if blended else stopped
        shown += weight
    return shown


@numba.njit(**_PART)
def live_runs(state):
    """First and last (exclusive) run in which some pixel still takes light."""
    first = _RUNS
    last = 0
    for run in range(_RUNS):
        most = -ONE
        for j in range(np.uint64(run * LANES), np.uint64(run * LANES + LANES)):
            most = max(most, state[_LIGHT + j])
        if most > ZERO:
            first = min(first, run)
            last = run + 1
    return first, last


@numba.njit(**_PART)
def clear_state(state, left, top, width, height):
    """Set pixels to full light; those outside the image take none."""
    state[:] = ZERO
    for row in range(TILE_HEIGHT):
        for col in range(TILE_WIDTH):
            j = np.uint64(row * TILE_WIDTH + col)
            state[_X + j] = left + col
            state[_Y + j] = top + row
            state[_LIGHT + j] = ONE if (left + col < width) & (top + row < height) else -ONE


@numba.njit(**_PART)
def write_maps(state, left, top, z_reference, depth, normal, alpha, distortion, median_depth):
    """Write a tile's state into the image."""
    height, width = depth.shape
    for y in range(top, min(top + TILE_HEIGHT, height)):
        for x in range(left, min(left + TILE_WIDTH, width)):
            j = np.uint64((y - top) * TILE_WIDTH + x - left)
            total = ONE - abs(state[_LIGHT + j])
            covered = state[_LAST + j] > ZERO
            depth[y, x] = z_reference + state[_MOMENT + j] / total if covered else ZERO
            alpha[y, x] = total
            normal[y, x, 0] = state[_NORMAL_X + j]
            normal[y, x, 1] = state[_NORMAL_Y + j]
            normal[y, x, 2] = state[_NORMAL_Z + j]
            distortion[y, x] = TWO * state[_DISTORTION + j]
            median_depth[y, x] = state[_MEDIAN + j]


@numba.njit(**PER_PIXEL)
def blend_tiles(
    first_tile, last_tile, records, offsets, lists, runs, inverse_near,
    depth, normal, alpha, distortion, median_depth, visible, saved, state,
):  # fmt: skip
    """Render the tiles first_tile..last_tile; ``state`` is scratch of BLEND_PLANES planes.

    ``saved`` (tiles, SAVED, TILE_PIXELS) receives the start of the backward pass; give it no tiles
    if there is no backward pass. ``visible`` is only ever set.
    """
    height, width = depth.shape
    columns = (width + TILE_WIDTH - 1) // TILE_WIDTH
    for tile in range(first_tile, last_tile):
        left, top = tile % columns * TILE_WIDTH, tile // columns * TILE_HEIGHT
        clear_state(state, left, top, width, height)
        first = offsets[tile]
        last = offsets[tile + 1]
        z_reference = reference_depth(records, lists, first, last) if last > first else ZERO
        first_run, last_run = live_runs(state)
        for k in range(first, last):
            i = lists[k]
            start, stop = common_runs(runs, k, first_run, last_run)
            rank = np.float32(k - first + 1)
            shown = blend_disk(state, start, stop, records[i], rank, z_reference, inverse_near)
            if shown > ZERO:
                visible[i] = True
            if (k - first) % CHECK_EVERY == CHECK_EVERY - 1:
                first_run, last_run = live_runs(state)
                if first_run >= last_run:
                    break
        write_maps(state, left, top, z_reference, depth, normal, alpha, distortion, median_depth)
        if saved.shape[0] > 0:
            for j in range(TILE_PIXELS):
                k = np.uint64(j)
                saved[tile, at.SAVED_LIGHT, j] = abs(state[_LIGHT + k])
                saved[tile, at.SAVED_MOMENT, j] = state[_MOMENT + k]
                saved[tile, at.SAVED_LAST, j] = state[_LAST + k]
