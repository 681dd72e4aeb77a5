"""Meshes for other programs: binary glTF (GLB) and Wavefront OBJ."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from geogs.io.writers.atomic import atomic_file
from geogs.io.writers.exports.gltf import PLAIN, GltfBuffer
from geogs.io.writers.exports.records import OPENGL_FROM_OPENCV

_QUALITY = 92
"""Of the JPEG in a textured mesh."""


def write_glb(
    path: Path,
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "m 3"],
    normals: Float[np.ndarray, "n 3"],
    colours: UInt8[np.ndarray, "n 3"] | None,
) -> None:
    """Write glTF 2.0 in one file: y up, looking along -z, counter-clockwise faces.

    The world is turned by a half turn about x, so that what was down in the first image is down.
    Colours are linear in the file, as glTF has them; ours are sRGB.
    """
    turn = OPENGL_FROM_OPENCV[:3, :3]
    gltf = GltfBuffer()
    attributes = {
        "POSITION": gltf.add(vertices @ turn, "VEC3", has_range=True),
        "NORMAL": gltf.add(normals @ turn, "VEC3"),
    }
    corners = gltf.add_corners(faces)
    if colours is not None:
        steps = np.round(linear(colours) * 65535).astype("<u2")
        opaque = np.concatenate([steps, np.full((len(steps), 1), 65535, "<u2")], 1)
        attributes["COLOR_0"] = gltf.add_steps(opaque)
    gltf.write(path, attributes, corners, PLAIN)


def write_textured_glb(
    path: Path,
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "m 3"],
    normals: Float[np.ndarray, "n 3"],
    texture_place: Float[np.ndarray, "n 2"],
    texture: UInt8[np.ndarray, "h w 3"],
) -> None:
    """Write glTF 2.0 in one file, with axes as ``write_glb`` has them and a JPEG inside.

    Light is in the texture already, so the material asks to be shown as it is
    (KHR_materials_unlit); readers that do not know that see a rough surface. ``texture_place`` is
    in pixels of the texture, whose centres are at integers.
    """
    turn = OPENGL_FROM_OPENCV[:3, :3]
    size = np.array(texture.shape[1::-1])
    gltf = GltfBuffer()
    attributes = {
        "POSITION": gltf.add(vertices @ turn, "VEC3", has_range=True),
        "NORMAL": gltf.add(normals @ turn, "VEC3"),
        "TEXCOORD_0": gltf.add((texture_place + 0.5) / size, "VEC2"),
    }
    corners = gltf.add_corners(faces)
    gltf.write(path, attributes, corners, gltf.textured(_jpeg(texture)))


def _jpeg(texture: UInt8[np.ndarray, "h w 3"]) -> bytes:
    options = [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
    _, data = cv2.imencode(".jpg", cv2.cvtColor(texture, cv2.COLOR_RGB2BGR), options)
    return data.tobytes()


def write_obj(
    path: Path,
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "m 3"],
    normals: Float[np.ndarray, "n 3"],
    colours: UInt8[np.ndarray, "n 3"] | None,
) -> None:
    """Write text with normals, y up as in ``write_glb``; sRGB from 0 to 1 stands behind x, y, z."""
    turn = OPENGL_FROM_OPENCV[:3, :3]
    rows = vertices @ turn
    if colours is not None:
        rows = np.concatenate([rows, colours / 255.0], 1)
    lines = ["v " + " ".join(f"{x:.7g}" for x in row) for row in rows.tolist()]
    lines += ["vn " + " ".join(f"{x:.5g}" for x in row) for row in (normals @ turn).tolist()]
    lines += [f"f {a}//{a} {b}//{b} {c}//{c}" for a, b, c in (faces + 1).tolist()]
    with atomic_file(path) as stream:
        stream.write(("\n".join(lines) + "\n").encode())


def linear(colours: UInt8[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """sRGB from 0 to 255 as light from 0 to 1 (IEC 61966-2-1)."""
    share = colours / 255.0
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
