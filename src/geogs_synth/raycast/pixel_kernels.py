"""Ray casting and shading of the pixels of a view, compiled.

Rays are o + t d with d_z = 1 in the camera frame, so that t is the depth.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from geogs_synth.raycast.solid_kernels import COMPILED, hit, outward_normal
from geogs_synth.scene.solids import BOX, FRUSTUM


class PlacedSolids(NamedTuple):
    """The scene's solids in the frame of one camera."""

    kind: np.ndarray  # n
    half: np.ndarray  # n 3
    rotation: np.ndarray  # n 3 3, local to world
    origin: np.ndarray  # n 3, camera centre in each local frame
    matrix: np.ndarray  # n 3 3, camera to local
    texture: np.ndarray  # n 6
    shift: np.ndarray  # n 2, metres
    emission: np.ndarray  # n


class Textures(NamedTuple):
    """All textures with their pyramids in one array; level k is half as large as level k - 1."""

    texels: np.ndarray  # flat uint8, RGB
    start: np.ndarray  # m levels
    width: np.ndarray  # m levels
    height: np.ndarray  # m levels
    texel: np.ndarray  # m, metres; 0 stretches over the face


class Traced(NamedTuple):
    """Hits, colours and normals of the pixels of a view."""

    depth: np.ndarray  # h w; inf where nothing is hit
    solid: np.ndarray  # h w; -1 where nothing is hit
    face: np.ndarray  # h w
    image: np.ndarray  # h w 3
    normal: np.ndarray  # h w 3, camera frame


class Lighting(NamedTuple):
    """Lights, and the fraction of each that is visible from every cell of the room."""

    volume: np.ndarray  # nz ny nx 1+l: ambient, then each light, in [0, 1]
    voxel: float
    position: np.ndarray  # l 3
    colour: np.ndarray  # l 3
    above: np.ndarray  # 3, ambient from above
    below: np.ndarray  # 3, ambient from below


@njit(**COMPILED)
def _hit_pixel(solids, i, x, y):
    """Depth and face at which the pixel ray (x, y, 1) meets solid i."""
    o = solids.origin[i]
    m = solids.matrix[i]
    dx = m[0, 0] * x + m[0, 1] * y + m[0, 2]
    dy = m[1, 0] * x + m[1, 1] * y + m[1, 2]
    dz = m[2, 0] * x + m[2, 1] * y + m[2, 2]
    return hit(solids.kind[i], solids.half[i], o[0], o[1], o[2], dx, dy, dz)


@njit(**COMPILED)
def cast_rows(solids, bounds, xs, ys, first, last, traced):
    """Nearest solid in rows [first, last) of the rays (xs, ys, 1), both rows x columns.

    ``bounds`` are (left, top, right, bottom) in pixels, a row for each solid.
    """
    for i in range(len(solids.kind)):
        for row in range(max(first, bounds[i, 1]), min(last, bounds[i, 3])):
            for column in range(bounds[i, 0], bounds[i, 2]):
                t, f = _hit_pixel(solids, i, xs[row, column], ys[row, column])
                if t < traced.depth[row, column]:
                    traced.depth[row, column] = t
                    traced.solid[row, column] = i
                    traced.face[row, column] = f


@njit(**COMPILED)
def _surface_coordinates(kind, half, face, px, py, pz):
    """Metres to the right and up on the face as seen from outside, and the face's width, height."""
    if kind == BOX:
        if face < 2:
            return (py if face else -py), pz, 2.0 * half[1], 2.0 * half[2]
        if face < 4:
            return (-px if face == 3 else px), pz, 2.0 * half[0], 2.0 * half[2]
        return (px if face == 5 else -px), py, 2.0 * half[0], 2.0 * half[1]
    if kind == FRUSTUM:
        if face >= 4:
            width = 2.0 * half[face - 4]
            return px, py, width, width
        radius = 0.5 * (half[0] + half[1])
        return math.atan2(py, px) * radius, pz, 2.0 * math.pi * radius, 2.0 * half[2]
    latitude = math.asin(min(1.0, max(-1.0, pz / half[2])))
    longitude = math.atan2(py / half[1], px / half[0])
    width = 2.0 * math.pi * half[0]
    return longitude * half[0], latitude * half[2], width, math.pi * half[2]


@njit(**COMPILED)
def _add_bilinear(texels, start, w, h, u, v, wrap, weight, out):
    """Adds ``weight`` times a w x h level of a texture at position (u, v) in [0, 1]."""
    if wrap:
        u, v = u - math.floor(u), v - math.floor(v)
    u, v = u * w - 0.5, v * h - 0.5
    c = math.floor(u)
    r = math.floor(v)
    fu, fv = u - c, v - r
    c0 = int(c)
    r0 = int(r)
    c1 = c0 + 1
    r1 = r0 + 1
    # Beyond the border: the opposite border, or the border itself.
    c0 = (c0 if c0 >= 0 else (w - 1 if wrap else 0)) if c0 < w else w - 1
    r0 = (r0 if r0 >= 0 else (h - 1 if wrap else 0)) if r0 < h else h - 1
    c1 = c1 if c1 < w else (0 if wrap else w - 1)
    r1 = r1 if r1 < h else (0 if wrap else h - 1)
    top, bottom = start + 3 * r0 * w, start + 3 * r1 * w
    for k in range(3):
        upper = (1.0 - fu) * texels[top + 3 * c0 + k] + fu * texels[top + 3 * c1 + k]
        lower = (1.0 - fu) * texels[bottom + 3 * c0 + k] + fu * texels[bottom + 3 * c1 + k]
        out[k] += weight * ((1.0 - fv) * upper + fv * lower)


@njit(**COMPILED)
def _texture_colour(solids, textures, i, face, point, footprint, out):
    """Texture of a surface point, low-passed to ``footprint`` metres (trilinear filtering)."""
    kind = solids.kind[i]
    half = solids.half[i]
    across, up, face_width, face_height = _surface_coordinates(
        kind, half, face, point[0], point[1], point[2]
    )
    j = solids.texture[i, face]
    start = textures.start[j]
    width = textures.width[j]
    height = textures.height[j]
    texel = textures.texel[j]
    wrap = texel > 0.0 or kind != BOX
    if texel > 0.0:
        u = (across + solids.shift[i, 0]) / (texel * width[0])
        v = -(up + solids.shift[i, 1]) / (texel * height[0])
    else:
        u, v = across / face_width + 0.5, 0.5 - up / face_height
        texel = max(face_width / width[0], face_height / height[0])
    level = min(max(math.log2(footprint / texel), 0.0), len(start) - 1.0)
    low = int(level)
    part = level - low
    out[:] = 0.0
    _add_bilinear(textures.texels, start[low], width[low], height[low], u, v, wrap, 1 - part, out)
    if part > 0.0:
        k = low + 1
        _add_bilinear(textures.texels, start[k], width[k], height[k], u, v, wrap, part, out)


@njit(**COMPILED)
def _bilinear(volume, z, y, x, channel, fx, fy):
    """Value between four cells of a slice of the light volume."""
    near = (1 - fx) * volume[z, y, x, channel] + fx * volume[z, y, x + 1, channel]
    far = (1 - fx) * volume[z, y + 1, x, channel] + fx * volume[z, y + 1, x + 1, channel]
    return (1 - fy) * near + fy * far


@njit(**COMPILED)
def _light(lighting, point, normal, out):
    """Display gain sqrt(E) of a diffuse surface from lights and ambient, with soft occlusion.

    With a display gamma of 2, textures hold sqrt(albedo): times this gain, the displayed radiance.
    """
    volume = lighting.volume
    voxel = lighting.voxel
    nz, ny, nx, channels = volume.shape
    # Half a voxel off the surface, so that the cells read lie in front of it.
    gx = min(max((point[0] + 0.7 * voxel * normal[0]) / voxel - 0.5, 0.0), nx - 1.001)
    gy = min(max((point[1] + 0.7 * voxel * normal[1]) / voxel - 0.5, 0.0), ny - 1.001)
    gz = min(max((point[2] + 0.7 * voxel * normal[2]) / voxel - 0.5, 0.0), nz - 1.001)
    x, y, z = int(gx), int(gy), int(gz)
    fx, fy, fz = gx - x, gy - y, gz - z
    sky = 0.5 + 0.5 * normal[2]
    out[:] = 0.0
    for channel in range(channels):
        low = _bilinear(volume, z, y, x, channel, fx, fy)
        high = _bilinear(volume, z + 1, y, x, channel, fx, fy)
        seen = (1 - fz) * low + fz * high
        if channel == 0:
            for k in range(3):
                out[k] += seen * (lighting.above[k] * sky + lighting.below[k] * (1.0 - sky))
            continue
        lx = lighting.position[channel - 1, 0] - point[0]
        ly = lighting.position[channel - 1, 1] - point[1]
        lz = lighting.position[channel - 1, 2] - point[2]
        square = lx * lx + ly * ly + lz * lz + 0.1
        cosine = (lx * normal[0] + ly * normal[1] + lz * normal[2]) / math.sqrt(square)
        if cosine > 0.0:
            for k in range(3):
                out[k] += seen * cosine / square * lighting.colour[channel - 1, k]
    for k in range(3):
        out[k] = math.sqrt(out[k])


@njit(**COMPILED)
def _surface(solids, camera, i, face, t, x, y, local, world, normal):
    """Fills the local and world point and world normal of a hit; returns |cos| of the incidence."""
    o = solids.origin[i]
    m = solids.matrix[i]
    r = solids.rotation[i]
    for k in range(3):
        local[k] = o[k] + t * (m[k, 0] * x + m[k, 1] * y + m[k, 2])
    n = outward_normal(solids.kind[i], solids.half[i], face, local[0], local[1], local[2])
    cosine = 0.0
    for k in range(3):
        ray = camera[k, 0] * x + camera[k, 1] * y + camera[k, 2]
        world[k] = camera[k, 3] + t * ray
        normal[k] = r[k, 0] * n[0] + r[k, 1] * n[1] + r[k, 2] * n[2]
        cosine += normal[k] * ray
    return abs(cosine) / math.sqrt(x * x + y * y + 1.0)


@njit(**COMPILED)
def _around(traced, row, column, found):
    """Collect the distinct faces (8 solid + face) seen in 3 x 3 pixels; return their number."""
    rows, columns = traced.solid.shape
    count = 0
    for r in range(max(row - 1, 0), min(row + 2, rows)):
        for c in range(max(column - 1, 0), min(column + 2, columns)):
            key = 8 * traced.solid[r, c] + traced.face[r, c]
            known = key < 0
            for k in range(count):
                known = known or found[k] == key
            if not known:
                found[count] = key
                count += 1
    return count


@njit(**COMPILED)
def _gain(solids, lighting, i, world, normal, out):
    """Factor on the texture of solid i."""
    if solids.emission[i] > 0.0:
        out[:] = solids.emission[i]
    else:
        _light(lighting, world, normal, out)


@njit(**COMPILED)
def shade_rows(solids, textures, lighting, camera, pixel, xs, ys, first, last, traced):
    """Colour and camera-frame normal of rows [first, last) from the hits of ``cast_rows``.

    ``pixel`` is the width and height of a pixel on the plane z = 1.

    Inside a face one sample with the texture low-passed to the pixel is enough. At an edge four
    samples are cast, only against the solids seen in the 3 x 3 pixels around.
    """
    found = np.empty(9, np.int64)
    local = np.empty(3)
    world = np.empty(3)
    normal = np.empty(3)
    gain = np.empty(3)
    edge_gain = np.empty(3)
    colour = np.empty(3)
    pixel_x, pixel_y = pixel
    for row in range(first, last):
        for column in range(xs.shape[1]):
            i = traced.solid[row, column]
            f = traced.face[row, column]
            t = traced.depth[row, column]
            x, y = xs[row, column], ys[row, column]
            if i < 0:
                continue
            cosine = _surface(solids, camera, i, f, t, x, y, local, world, normal)
            for k in range(3):
                traced.normal[row, column, k] = (
                    camera[0, k] * normal[0] + camera[1, k] * normal[1] + camera[2, k] * normal[2]
                )
            _gain(solids, lighting, i, world, normal, gain)
            footprint = t * pixel_x / math.sqrt(max(cosine, 0.05))
            count = _around(traced, row, column, found)
            if count == 1:
                _texture_colour(solids, textures, i, f, local, 0.7 * footprint, colour)
                for k in range(3):
                    traced.image[row, column, k] = min(colour[k] * gain[k], 255.0)
                continue
            for sample in range(4):
                dx = (0.25 if sample & 1 else -0.25) * pixel_x
                dy = (0.25 if sample & 2 else -0.25) * pixel_y
                ts = np.inf
                js = i
                fs = f
                for k in range(count):
                    tk, fk = _hit_pixel(solids, found[k] >> 3, x + dx, y + dy)
                    if tk < ts:
                        ts = tk
                        js = found[k] >> 3
                        fs = fk
                if ts == np.inf:
                    ts = t
                    dx = 0.0
                    dy = 0.0
                _surface(solids, camera, js, fs, ts, x + dx, y + dy, local, world, normal)
                _texture_colour(solids, textures, js, fs, local, 0.5 * footprint, colour)
                if js == i and fs == f:
                    edge_gain[:] = gain
                else:
                    _gain(solids, lighting, js, world, normal, edge_gain)
                for k in range(3):
                    traced.image[row, column, k] += 0.25 * min(colour[k] * edge_gain[k], 255.0)
