"""PLY files: the coloured mesh, and the disks as splats for 3D Gaussian splatting viewers.

Written by hand, as a library would be a dependency without splats: trimesh takes half as long again
for a million faces and adds an alpha channel.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from geogs.guard.atomic import atomic_file
from geogs.types import MapSnapshot

SPLAT_THICKNESS = 0.01
"""Third standard deviation of an exported splat relative to its smaller one: flat, not zero."""

_TYPES = {"<f4": "float", "|u1": "uchar"}
SH_DEGREE_0 = 0.28209479177387814
"""1 / (2 sqrt(pi)), the constant spherical harmonic."""


@dataclass(frozen=True)
class _Element:
    """A table of a PLY file: packed little-endian rows, and the header lines of a row."""

    name: str
    table: np.ndarray
    properties: list[str]


def write_mesh(
    path: str | Path,
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "m 3"],
    colours: UInt8[np.ndarray, "n 3"] | None = None,
    normals: Float[np.ndarray, "n 3"] | None = None,
) -> None:
    """Write a triangle mesh as binary PLY, with RGB and normals at the vertices where given."""
    triangles = np.empty(len(faces), dtype=[("count", "u1"), ("corners", "<i4", (3,))])
    triangles["count"] = 3
    triangles["corners"] = faces
    _write(
        path,
        [
            _vertices(_points(vertices, colours, normals)),
            _Element("face", triangles, ["list uchar int vertex_indices"]),
        ],
    )


def write_points(
    path: str | Path,
    positions: Float[np.ndarray, "n 3"],
    colours: UInt8[np.ndarray, "n 3"] | None = None,
    normals: Float[np.ndarray, "n 3"] | None = None,
) -> None:
    """Write a point cloud as binary PLY, with RGB and normals where given."""
    _write(path, [_vertices(_points(positions, colours, normals))])


def splat_scales(disks: MapSnapshot) -> Float[np.ndarray, "n 3"]:
    """Standard deviations of the disks as splats, along tangents and normal: thin, not flat."""
    scale = disks.scale.cpu().numpy()
    thin = SPLAT_THICKNESS * scale.min(axis=1, keepdims=True, initial=np.inf)
    return np.concatenate([scale, thin], axis=1).clip(1e-12)


def write_splats(
    path: str | Path,
    disks: MapSnapshot,
    colours: Float[np.ndarray, "n 3"],
    is_flat: bool = False,
    degree: int = 0,
) -> None:
    """Write disks in the layout of 3D Gaussian splatting (Kerbl et al. 2023), no view dependence.

    Scales are logarithms, opacity a logit, rotation w, x, y, z, colour the zeroth coefficient of
    spherical harmonics; the third scale is made thin.

    Args:
        path: the file.
        disks: the map.
        colours: RGB of every disk in [0, 1]; the map itself has none.
        is_flat: whether there are two scales, as in 2D Gaussian splatting (Huang et al. 2024).
        degree: of the spherical harmonics, for readers that want more than the constant one; their
            coefficients are zero.
    """
    rest = [f"f_rest_{i}" for i in range(3 * ((degree + 1) ** 2 - 1))]
    scales = ("scale_0", "scale_1") if is_flat else ("scale_0", "scale_1", "scale_2")
    position = disks.position.cpu().numpy()
    normal = disks.normal.cpu().numpy()
    rotation = disks.quaternion.cpu().numpy()
    opacity = disks.opacity.cpu().double().numpy().clip(1e-6, 1 - 1e-6)
    log_scale = np.log(splat_scales(disks))
    columns = {
        **_columns(position, ("x", "y", "z")),
        **_columns(normal, ("nx", "ny", "nz")),
        **_columns((colours - 0.5) / SH_DEGREE_0, ("f_dc_0", "f_dc_1", "f_dc_2")),
        **_columns(np.zeros((len(position), len(rest))), tuple(rest)),
        "opacity": np.log(opacity / (1 - opacity)).astype("<f4"),
        **_columns(log_scale, scales),
        **_columns(rotation, ("rot_0", "rot_1", "rot_2", "rot_3")),
    }
    _write(path, [_vertices(columns)])


def _points(
    positions: Float[np.ndarray, "n 3"],
    colours: UInt8[np.ndarray, "n 3"] | None,
    normals: Float[np.ndarray, "n 3"] | None,
) -> dict[str, np.ndarray]:
    columns = _columns(positions, ("x", "y", "z"))
    if normals is not None:
        columns |= _columns(normals, ("nx", "ny", "nz"))
    if colours is not None:
        columns |= {name: colours[:, i] for i, name in enumerate(("red", "green", "blue"))}
    return columns


def _columns(values: Float[np.ndarray, "n k"], names: tuple[str, ...]) -> dict[str, np.ndarray]:
    return {name: values[:, i].astype("<f4") for i, name in enumerate(names)}


def _vertices(columns: dict[str, np.ndarray]) -> _Element:
    dtype = [(column, values.dtype.str) for column, values in columns.items()]
    table = np.empty(len(next(iter(columns.values()))), dtype=dtype)
    for column, values in columns.items():
        table[column] = values
    return _Element("vertex", table, [f"{_TYPES[dtype]} {column}" for column, dtype in dtype])


def _write(path: str | Path, elements: list[_Element]) -> None:
    """Header and tables in one go."""
    header = ["ply", "format binary_little_endian 1.0"]
    for element in elements:
        header.append(f"element {element.name} {len(element.table)}")
        header += [f"property {text}" for text in element.properties]
    with atomic_file(path) as stream:
        stream.write("\n".join([*header, "end_header\n"]).encode())
        for element in elements:
            stream.write(element.table.tobytes())
