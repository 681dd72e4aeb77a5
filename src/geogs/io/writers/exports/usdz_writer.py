"""USDZ, the format of models on phones: https://openusd.org/release/spec_usdz.html.

An archive without compression, whose files begin at multiples of 64 bytes: the model as text, and
its texture.
"""

import zipfile
from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from geogs.guard.atomic import atomic_file
from geogs.io.pose_files import OPENCV_FROM_OPENGL
from geogs.io.writers.exports.mesh_writers import encoded_jpeg, linear

_TEXTURE = "texture.jpg"
_SHADED = """
  def Material "material" {
    token outputs:surface.connect = </surface/material/preview.outputs:surface>
    def Shader "preview" {
      uniform token info:id = "UsdPreviewSurface"
      color3f inputs:diffuseColor.connect = </surface/material/picture.outputs:rgb>
      float inputs:roughness = 1
      float inputs:metallic = 0
      token outputs:surface
    }
    def Shader "picture" {
      uniform token info:id = "UsdUVTexture"
      asset inputs:file = @texture.jpg@
      token inputs:sourceColorSpace = "sRGB"
      token inputs:wrapS = "clamp"
      token inputs:wrapT = "clamp"
      float2 inputs:st.connect = </surface/material/place.outputs:result>
      float3 outputs:rgb
    }
    def Shader "place" {
      uniform token info:id = "UsdPrimvarReader_float2"
      string inputs:varname = "st"
      float2 outputs:result
    }
  }"""
"""The material of a surface with a texture."""


Texture = tuple[Float[np.ndarray, "n 2"], UInt8[np.ndarray, "h w 3"]]
"""Place of each vertex in pixels of a texture, whose centres are at integers, and the texture."""


def write_usdz(
    path: Path,
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "m 3"],
    normals: Float[np.ndarray, "n 3"],
    look: UInt8[np.ndarray, "n 3"] | Texture | None,
    metres: float = 1.0,
) -> None:
    """Write a mesh, given with y down, with y up.

    Args:
        path: the file.
        vertices: positions.
        faces: counter-clockwise seen from free space.
        normals: of the vertices.
        look: RGB of the vertices, which phones do not show, or a texture.
        metres: length of a unit.

    Raises:
        OutputError: the file cannot be written.
    """
    parts = _geometry(vertices, faces, normals)
    files = {}
    material = ""
    if isinstance(look, tuple):
        uv, texture = look
        st = (uv + 0.5) / np.array(texture.shape[1::-1])
        st[:, 1] = 1 - st[:, 1]
        parts.append(f'texCoord2f[] primvars:st = [{_rows(st)}] (interpolation = "vertex")')
        parts.append("rel material:binding = </surface/material>")
        material = _SHADED
        files[_TEXTURE] = encoded_jpeg(texture)
    elif look is not None:
        colours = _rows(linear(look))
        parts.append(f'color3f[] primvars:displayColor = [{colours}] (interpolation = "vertex")')
    schemas = ' (prepend apiSchemas = ["MaterialBindingAPI"])' if material else ""
    lines = "\n    ".join(parts)
    model = (
        f'#usda 1.0\n(defaultPrim = "surface"\n metersPerUnit = {metres:g}\n upAxis = "Y")\n'
        f'def Xform "surface" (kind = "component") {{\n  def Mesh "mesh"{schemas} {{\n    {lines}\n'
        f"  }}{material}\n}}\n"
    )
    with atomic_file(path) as stream:
        stream.write(_archive({"model.usda": model.encode(), **files}))


def _geometry(
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "m 3"],
    normals: Float[np.ndarray, "n 3"],
) -> list[str]:
    """Attributes of a mesh, turned to y up."""
    axes = OPENCV_FROM_OPENGL[:3, :3]
    points = vertices @ axes
    return [
        f"float3[] extent = [{_rows(np.stack([points.min(0), points.max(0)]))}]",
        "int[] faceVertexCounts = [" + ", ".join(["3"] * len(faces)) + "]",
        "int[] faceVertexIndices = [" + ", ".join(map(str, faces.ravel().tolist())) + "]",
        f"point3f[] points = [{_rows(points)}]",
        f'normal3f[] normals = [{_rows(normals @ axes)}] (interpolation = "vertex")',
        'uniform token subdivisionScheme = "none"',
    ]


def _rows(values: Float[np.ndarray, "n k"]) -> str:
    return ", ".join("(" + ", ".join(f"{x:.6g}" for x in row) + ")" for row in values.tolist())


def _archive(files: dict[str, bytes]) -> bytes:
    """The files in one, each at a multiple of 64 bytes; padded by an extra field of its header."""
    buffer = BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, data in files.items():
            entry = zipfile.ZipInfo(name)
            begins = buffer.tell() + 30 + len(name) + 4  # of a header with an empty extra field
            padding = -begins % 64
            entry.extra = b"\x86\x19" + padding.to_bytes(2, "little") + bytes(padding)
            archive.writestr(entry, data)
    return buffer.getvalue()
