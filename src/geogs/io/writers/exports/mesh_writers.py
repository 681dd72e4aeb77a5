"""Meshes for other programs: binary glTF 2.0 (GLB) and Wavefront OBJ.

https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html. The container of one mesh is a hundred
lines; a library for it (trimesh, pygltflib) would be a dependency of every installation.
"""

import json
import struct
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8, UInt16

from geogs.guard.atomic import atomic_file
from geogs.io.pose_files import OPENCV_FROM_OPENGL

_QUALITY = 92
"""Quality of the JPEG in a textured mesh."""
_FLOAT, _UINT16, _UINT32 = 5126, 5123, 5125
_VERTICES, _CORNERS = 34962, 34963
_LINEAR, _LINEAR_MIPMAP, _CLAMP = 9729, 9987, 33071
_UNLIT = "KHR_materials_unlit"

Material = dict[str, object]
"""Entries of the document for the material."""

_ROUGH = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
PLAIN: Material = {"materials": [{"pbrMetallicRoughness": _ROUGH, "doubleSided": True}]}
"""Rough, seen from both sides, in the colours of the vertices."""
ONE_SIDED: Material = {"materials": [{"pbrMetallicRoughness": _ROUGH}]}
"""The same, transparent from behind, so that a room can be seen from outside."""


class GltfBuffer:
    """Binary buffer of arrays, with their entries in the document."""

    def __init__(self) -> None:
        self._accessors: list[dict[str, object]] = []
        self._views: list[dict[str, object]] = []
        self._data = b""

    def add_surface(
        self, vertices: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]
    ) -> dict[str, int]:
        """Add vertices and normals, in the axes of glTF. Returns their accessor numbers."""
        axes = OPENCV_FROM_OPENGL[:3, :3]
        return {
            "POSITION": self.add(vertices @ axes, "VEC3", has_range=True),
            "NORMAL": self.add(normals @ axes, "VEC3"),
        }

    def add(self, values: Float[np.ndarray, "n k"], kind: str, has_range: bool = False) -> int:
        """Add vertex data as float32; ``has_range`` for positions. Returns the accessor number."""
        rows = values.astype("<f4")
        entry: dict[str, object] = {"componentType": _FLOAT, "type": kind}
        if has_range:
            entry |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        return self._accessor(rows, _VERTICES, entry)

    def add_steps(self, values: UInt16[np.ndarray, "n 4"]) -> int:
        """Add vertex colours in steps of 1 / 65535. Returns the accessor number."""
        entry = {"componentType": _UINT16, "type": "VEC4", "normalized": True}
        return self._accessor(values, _VERTICES, entry)

    def add_corners(self, faces: Int[np.ndarray, "m 3"]) -> int:
        """Add the vertex indices of the triangles. Returns the accessor number."""
        entry: dict[str, object] = {"componentType": _UINT32, "type": "SCALAR"}
        return self._accessor(faces.astype("<u4").reshape(-1), _CORNERS, entry)

    def textured(self, jpeg: bytes) -> Material:
        """The unlit material of a surface with a texture."""
        picture = {"mimeType": "image/jpeg", "bufferView": self._view(jpeg)}
        filters = {"magFilter": _LINEAR, "minFilter": _LINEAR_MIPMAP}
        surface = {"baseColorTexture": {"index": 0}, **_ROUGH}
        material = {
            "pbrMetallicRoughness": surface,
            "doubleSided": True,
            "extensions": {_UNLIT: {}},
        }
        return {
            "extensionsUsed": [_UNLIT],
            "materials": [material],
            "images": [picture],
            "samplers": [{**filters, "wrapS": _CLAMP, "wrapT": _CLAMP}],
            "textures": [{"source": 0, "sampler": 0}],
        }

    def packed(self, attributes: dict[str, int], corners: int, look: Material) -> bytes:
        """The file with one mesh of these arrays."""
        primitive = {"attributes": attributes, "indices": corners, "material": 0}
        document = {
            "asset": {"version": "2.0", "generator": "geogs"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0, "name": "surface"}],
            "meshes": [{"primitives": [primitive]}],
            **look,
            "accessors": self._accessors,
            "bufferViews": self._views,
            "buffers": [{"byteLength": len(self._data)}],
        }
        text = json.dumps(document).encode()
        data = self._data
        text += b" " * (-len(text) % 4)
        data += b"\0" * (-len(data) % 4)
        return b"".join(
            [
                struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(data)),
                struct.pack("<I4s", len(text), b"JSON"),
                text,
                struct.pack("<I4s", len(data), b"BIN\0"),
                data,
            ]
        )

    def _accessor(self, values: np.ndarray, target: int, entry: dict[str, object]) -> int:
        view = self._view(values.tobytes(), {"target": target})
        self._accessors.append({"bufferView": view, "count": len(values), **entry})
        return len(self._accessors) - 1

    def _view(self, data: bytes, more: dict[str, int] | None = None) -> int:
        self._data += b"\0" * (-len(self._data) % 4)
        place = {"buffer": 0, "byteOffset": len(self._data), "byteLength": len(data)}
        self._views.append({**place, **(more or {})})
        self._data += data
        return len(self._views) - 1


def glb(
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "m 3"],
    normals: Float[np.ndarray, "n 3"],
    colours: UInt8[np.ndarray, "n 3"] | None,
    look: Material = PLAIN,
) -> bytes:
    """glTF 2.0 in one file: y up, looking along -z, counter-clockwise faces.

    The world is rotated by 180 degrees about x, so that down in the first image is down.
    Colours are linear in the file, as glTF has them; ours are sRGB.
    """
    gltf = GltfBuffer()
    attributes = gltf.add_surface(vertices, normals)
    corners = gltf.add_corners(faces)
    if colours is not None:
        steps = np.round(linear(colours) * 65535).astype("<u2")
        opaque = np.concatenate([steps, np.full((len(steps), 1), 65535, "<u2")], 1)
        attributes["COLOR_0"] = gltf.add_steps(opaque)
    return gltf.packed(attributes, corners, look)


def write_textured_glb(
    path: Path,
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "m 3"],
    normals: Float[np.ndarray, "n 3"],
    uv: Float[np.ndarray, "n 2"],
    texture: UInt8[np.ndarray, "h w 3"],
) -> None:
    """Write glTF 2.0 in one file, with axes as ``glb`` has them and a JPEG inside.

    Light is in the texture already, so the material is unlit (KHR_materials_unlit); readers
    without that extension show a rough surface. ``uv`` is in pixels of the texture, whose
    centres are at integers.
    """
    gltf = GltfBuffer()
    size = np.array(texture.shape[1::-1])
    attributes = gltf.add_surface(vertices, normals)
    attributes["TEXCOORD_0"] = gltf.add((uv + 0.5) / size, "VEC2")
    corners = gltf.add_corners(faces)
    with atomic_file(path) as stream:
        stream.write(gltf.packed(attributes, corners, gltf.textured(encoded_jpeg(texture))))


def encoded_jpeg(texture: UInt8[np.ndarray, "h w 3"]) -> bytes:
    """A texture as JPEG."""
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
    """Write text with normals, y up as in ``glb``; sRGB from 0 to 1 follows x, y, z."""
    axes = OPENCV_FROM_OPENGL[:3, :3]
    rows = vertices @ axes
    if colours is not None:
        rows = np.concatenate([rows, colours / 255.0], 1)
    lines = ["v " + " ".join(f"{x:.7g}" for x in row) for row in rows.tolist()]
    lines += ["vn " + " ".join(f"{x:.5g}" for x in row) for row in (normals @ axes).tolist()]
    lines += [f"f {a}//{a} {b}//{b} {c}//{c}" for a, b, c in (faces + 1).tolist()]
    with atomic_file(path) as stream:
        stream.write(("\n".join(lines) + "\n").encode())


def write_stl(
    path: Path, vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]
) -> None:
    """Write binary STL with z up, for printers and CAD: no colours, and no unit."""
    corners = vertices.astype(np.float64)[faces] @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    rows = np.zeros(len(faces), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    rows["normal"] = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-30)
    rows["corners"] = corners
    with atomic_file(path) as stream:
        stream.write(b"geogs".ljust(80) + struct.pack("<I", len(faces)) + rows.tobytes())


def linear(colours: UInt8[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """sRGB from 0 to 255 as light from 0 to 1 (IEC 61966-2-1)."""
    level = colours / 255.0
    return np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)
