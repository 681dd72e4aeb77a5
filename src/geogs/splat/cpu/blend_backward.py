"""Gradients through the compositing, back to front."""

import numba
import numpy as np

from geogs.kernel_parts import inlined
from geogs.splat.cpu import layout as at
from geogs.splat.cpu.blend import CHECK_EVERY, common_runs, reference_depth
from geogs.splat.cpu.layout import (
    LANES,
    MAX_ALPHA,
    MIN_ALPHA,
    MIN_HIT_RATIO,
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
(
    _X, _Y, _LIGHT, _MOMENT, _LAST, _BEHIND, _SIGNS, _SIGNED_Z,
    _D_CONSTANT, _D_Z, _D_NORMAL_X, _D_NORMAL_Y, _D_NORMAL_Z, _D_DISTORTION,
    _ALPHA, _DEPTH, _FREE_DEPTH, _U, _V, _BEND, _BLUR,
) = (np.uint64(k * PLANE) for k in range(21))  # fmt: skip
UNBLEND_PLANES = 21
_RUN = np.uint64(LANES)
_RUNS = TILE_PIXELS // LANES


@numba.njit(**_PART)
def meet_disk(state, first, last, r, rank, inverse_near):
    """Intersect one disk with the runs first..last of a tile, as the forward pass does.

    Per pixel: ALPHA, 0 where it was not blended; DEPTH; FREE_DEPTH, the same where it follows the
    plane and else 0; and where the Gaussian is that of the plane, z u in U, z v in V and z rho in
    BEND, else 0, and 1 in BLUR.
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
        z_kept = min(max(z, nearest), furthest)
        free = on_plane | ((z_kept == z) & (bounded == w))
        a = opacity * exp_minus(rho3 if on_plane else rho2)
        blended = (a >= MIN_ALPHA) & (state[_LAST + j] >= rank)
        state[_ALPHA + j] = min(a, MAX_ALPHA) if blended else ZERO
        state[_DEPTH + j] = z if on_plane else z_kept
        state[_FREE_DEPTH + j] = z if free else ZERO
        state[_U + j] = u * z if on_plane else ZERO
        state[_V + j] = v * z if on_plane else ZERO
        state[_BEND + j] = rho3 * z if on_plane else ZERO
        state[_BLUR + j] = ZERO if on_plane else ONE


@numba.njit(**_PART)
def unblend_disk(state, first, last, r, rank, z_reference, inverse_near, g):
    """Take one disk out of the runs first..last of a tile; ``g`` receives its gradients.

    Going back to front, with sums over the disks i behind: BEHIND of w_i dL/dw_i, SIGNS of w_i s_i
    and SIGNED_Z of w_i s_i z_i, where s_i is the sign of z_i A_i - Z_i; LIGHT and MOMENT become
    those in front of the disk. With q = z A - Z the distortion gives

        dL/dw = 2 |q| + 2 sum_{i behind} w_i s_i (z_i - z),
        dL/dz = 2 w (s A - sum_{i behind} w_i s_i).

    There are two loops, because in one the long chain of dependent results of each pixel would
    stall the processor.
    """
    meet_disk(state, first, last, r, rank, inverse_near)
    mx = r[at.MX]
    my = r[at.MY]
    opacity = r[at.OPACITY]
    nx, ny, nz = r[at.NX], r[at.NY], r[at.NZ]
    s_u = s_ux = s_uy = s_v = s_vx = s_vy = s_w = s_wx = s_wy = ZERO
    s_clamped = s_mx = s_my = s_opacity = s_nx = s_ny = s_nz = ZERO
    for j in range(first * _RUN, last * _RUN):
        dx, dy = state[_X + j] - mx, state[_Y + j] - my
        a = state[_ALPHA + j]
        zc = state[_DEPTH + j] - z_reference
        z_free = state[_FREE_DEPTH + j]
        inverse = ONE / (ONE - a)
        light_behind = state[_LIGHT + j]
        light = light_behind * inverse
        weight = light * a
        moment = state[_MOMENT + j] - weight * zc
        covered = ONE - light
        q = zc * covered - moment
        sign = ONE if q > ZERO else -ONE
        d_z = state[_D_Z + j]
        d_distortion = state[_D_DISTORTION + j]
        h_x, h_y, h_z = state[_D_NORMAL_X + j], state[_D_NORMAL_Y + j], state[_D_NORMAL_Z + j]
        signs = state[_SIGNS + j]
        signed_z = state[_SIGNED_Z + j]
        behind = state[_BEHIND + j]
        g_weight = state[_D_CONSTANT + j] + d_z * zc + h_x * nx + h_y * ny + h_z * nz
        g_weight += d_distortion * (abs(q) + signed_z - zc * signs)
        g_z = weight * (d_z + d_distortion * (sign * covered - signs))
        g_alpha = (light_behind * g_weight - behind) * inverse
        g_alpha = g_alpha * a if a < MAX_ALPHA else ZERO
        state[_LIGHT + j] = light
        state[_MOMENT + j] = moment
        state[_BEHIND + j] = behind + weight * g_weight
        state[_SIGNS + j] = signs + weight * sign
        state[_SIGNED_Z + j] = signed_z + weight * sign * zc

        g_rho = -TWO * g_alpha
        g_u = g_rho * state[_U + j]
        g_v = g_rho * state[_V + j]
        g_rho2 = g_rho * state[_BLUR + j]
        g_w = -z_free * z_free * g_z - g_rho * state[_BEND + j]
        s_u += g_u
        s_ux += g_u * dx
        s_uy += g_u * dy
        s_v += g_v
        s_vx += g_v * dx
        s_vy += g_v * dy
        s_w += g_w
        s_wx += g_w * dx
        s_wy += g_w * dy
        s_clamped += ZERO if z_free > ZERO else g_z
        s_mx -= g_rho2 * dx
        s_my -= g_rho2 * dy
        s_opacity += g_alpha
        s_nx += weight * h_x
        s_ny += weight * h_y
        s_nz += weight * h_z
    g[at.G_U] = s_u
    g[at.G_UX] = s_ux
    g[at.G_UY] = s_uy
    g[at.G_V] = s_v
    g[at.G_VX] = s_vx
    g[at.G_VY] = s_vy
    g[at.G_W] = s_w
    g[at.G_WX] = s_wx
    g[at.G_WY] = s_wy
    g[at.G_CLAMPED] = s_clamped
    g[at.G_MX] = s_mx
    g[at.G_MY] = s_my
    g[at.G_OPACITY] = s_opacity / opacity
    g[at.G_NX] = s_nx
    g[at.G_NY] = s_ny
    g[at.G_NZ] = s_nz


@numba.njit(**_PART)
def load_state(state, saved, left, top, d_depth, d_normal, d_alpha, d_distortion):
    """Load a tile's final state and the gradients of the loss with respect to its maps.

    Depth is Z / A, so dL/dw_i collects d_depth / A (z_i - depth); the part without z_i and d_alpha
    make D_CONSTANT.
    """
    height, width = d_depth.shape
    state[:] = ZERO
    for row in range(TILE_HEIGHT):
        for col in range(TILE_WIDTH):
            j = np.uint64(row * TILE_WIDTH + col)
            x, y = left + col, top + row
            state[_X + j] = x
            state[_Y + j] = y
            state[_LIGHT + j] = saved[at.SAVED_LIGHT, row * TILE_WIDTH + col]
            state[_MOMENT + j] = saved[at.SAVED_MOMENT, row * TILE_WIDTH + col]
            state[_LAST + j] = saved[at.SAVED_LAST, row * TILE_WIDTH + col]
            if (x < width) & (y < height) & (state[_LAST + j] > ZERO):
                total = ONE - state[_LIGHT + j]
                d_z = d_depth[y, x] / total
                state[_D_Z + j] = d_z
                state[_D_CONSTANT + j] = d_alpha[y, x] - d_z * state[_MOMENT + j] / total
                state[_D_NORMAL_X + j] = d_normal[y, x, 0]
                state[_D_NORMAL_Y + j] = d_normal[y, x, 1]
                state[_D_NORMAL_Z + j] = d_normal[y, x, 2]
                state[_D_DISTORTION + j] = TWO * d_distortion[y, x]


@numba.njit(**_PART)
def last_of_runs(state, last_of):
    """Rank of the last disk blended in each run; returns the largest."""
    most = ZERO
    for run in range(_RUNS):
        rank = ZERO
        for j in range(np.uint64(run * LANES), np.uint64(run * LANES + LANES)):
            rank = max(rank, state[_LAST + j])
        last_of[run] = rank
        most = max(most, rank)
    return int(most)


@numba.njit(**_PART)
def blended_runs(last_of, rank):
    """First and last (exclusive) run that blends some disk of at least this rank."""
    first = _RUNS
    last = 0
    for run in range(_RUNS):
        if last_of[run] >= rank:
            first = min(first, run)
            last = run + 1
    return first, last


@numba.njit(**PER_PIXEL)
def unblend_tiles(
    first_tile, last_tile, records, offsets, lists, runs, inverse_near, saved,
    d_depth, d_normal, d_alpha, d_distortion, gradients, state,
):  # fmt: skip
    """Gradients of every list entry of the tiles first_tile..last_tile.

    ``state`` is scratch of UNBLEND_PLANES planes.
    """
    width = d_depth.shape[1]
    columns = (width + TILE_WIDTH - 1) // TILE_WIDTH
    last_of = np.empty(_RUNS, np.float32)
    for tile in range(first_tile, last_tile):
        left, top = tile % columns * TILE_WIDTH, tile // columns * TILE_HEIGHT
        first = offsets[tile]
        last = offsets[tile + 1]
        if first == last:
            continue
        z_reference = reference_depth(records, lists, first, last)
        load_state(state, saved[tile], left, top, d_depth, d_normal, d_alpha, d_distortion)
        used = last_of_runs(state, last_of)
        for k in range(first + used, last):
            gradients[k, :] = ZERO
        first_run = 0
        last_run = _RUNS
        for k in range(first + used - 1, first - 1, -1):
            rank = np.float32(k - first + 1)
            if (k - first) % CHECK_EVERY == CHECK_EVERY - 1:
                first_run, last_run = blended_runs(last_of, k - first + 2 - CHECK_EVERY)
            start, stop = common_runs(runs, k, first_run, last_run)
            g = gradients[k]
            if start == stop:
                g[:] = ZERO
                continue
            unblend_disk(state, start, stop, records[lists[k]], rank, z_reference, inverse_near, g)
