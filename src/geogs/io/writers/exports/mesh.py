"""Meshes for other programs: binary glTF (GLB) and Wavefront OBJ."""

import json
import struct
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from geogs.io.writers.atomic import atomic_file
from geogs.io.writers.exports.records import OPENGL_FROM_OPENCV

_FLOAT, _UINT16, _UINT32 = 5126, 5123, 5125
_VERTICES, _CORNERS = 34962, 34963


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
    places = (vertices @ turn).astype("<f4")
    parts = [
        (places, "VEC3", _FLOAT, _VERTICES),
        ((normals @ turn).astype("<f4"), "VEC3", _FLOAT, _VERTICES),
        (faces.astype("<u4").reshape(-1), "SCALAR", _UINT32, _CORNERS),
    ]
    attributes = {"POSITION": 0, "NORMAL": 1}
    if colours is not None:
        steps = np.round(linear(colours) * 65535).astype("<u2")
        opaque = np.concatenate([steps, np.full((len(steps), 1), 65535, "<u2")], 1)
        parts.append((opaque, "VEC4", _UINT16, _VERTICES))
        attributes["COLOR_0"] = 3
    accessors: list[dict[str, object]] = []
    views, data = [], b""
    for number, (values, kind, component, target) in enumerate(parts):
        views.append({
            "buffer": 0, "byteOffset": len(data), "byteLength": values.nbytes, "target": target,
        })  # fmt: skip
        accessors.append({
            "bufferView": number, "componentType": component, "count": len(values), "type": kind,
        })  # fmt: skip
        data += values.tobytes()
    accessors[0] |= {"min": places.min(0).tolist(), "max": places.max(0).tolist()}
    if colours is not None:
        accessors[3]["normalized"] = True
    surface = {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}}
    primitive = {"attributes": attributes, "indices": 2, "material": 0}
    document = {
        "asset": {"version": "2.0", "generator": "geogs"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "surface"}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [{**surface, "doubleSided": True}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(data)}],
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    with atomic_file(path) as stream:
        stream.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(data)))
        stream.write(struct.pack("<I4s", len(text), b"JSON") + text)
        stream.write(struct.pack("<I4s", len(data), b"BIN\0") + data)


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
