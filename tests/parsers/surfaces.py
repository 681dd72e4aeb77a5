"""Meshes, clouds and what the DTU benchmark knows of a scan."""

from pathlib import Path

import numpy as np

import mutations
from geogs.evaluation.surfaces.dtu_errors import read_dtu_reference
from geogs.evaluation.surfaces.surface import read_surface
from geogs.io.writers.ply_writer import write_mesh
from geogs.mesh.mesh_file import read_mesh
from parsers.base import Parser, written

ASCII = (
    "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\n"
    "property float z\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n"
    "0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n3 0 2 3\n"
)


def surfaces() -> dict[str, Parser]:
    """By format."""
    scan = "Points/stl/stl001_total.ply"
    tables = ("ObsMask/ObsMask1_10.mat", "ObsMask/Plane1.mat")
    return {
        "ply-binary": Parser(mesh, ("m.ply",), mutations.binary, meshes),
        "ply-text": Parser(written("m.ply", ASCII), ("m.ply",), mutations.text, meshes),
        "ply-cloud": Parser(
            cloud, ("m.ply",), mutations.binary, lambda f: read_surface(f / "m.ply").vertices
        ),
        "dtu-reference": Parser(
            dtu, (*tables, scan), mutations.binary, lambda f: read_dtu_reference(f, 1)
        ),
    }  # fmt: skip


def mesh(folder: Path) -> None:
    """Two triangles with colours and normals."""
    vertices = np.random.default_rng(0).random((5, 3)).astype(np.float32)
    colours = np.full((5, 3), 128, np.uint8)
    write_mesh(folder / "m.ply", vertices, np.array([[0, 1, 2], [2, 3, 4]]), colours, vertices)


def cloud(folder: Path) -> None:
    """Points that are no mesh, in float64, of the other byte order."""
    points = np.random.default_rng(1).random((6, 3)).astype(">f8")
    axes = "".join(f"property double {axis}\n" for axis in "xyz")
    header = f"ply\nformat binary_big_endian 1.0\nelement vertex 6\n{axes}end_header\n"
    (folder / "m.ply").write_bytes(header.encode() + points.tobytes())


def dtu(folder: Path) -> None:
    """A scan with its masks."""
    from scipy.io import savemat

    (folder / "ObsMask").mkdir()
    (folder / "Points" / "stl").mkdir(parents=True)
    box = np.array([[-1.0, -1, -1], [2, 2, 2]])
    seen = {"ObsMask": np.ones((4, 4, 4), np.uint8), "BB": box, "Res": np.array([[1.0]])}
    savemat(folder / "ObsMask" / "ObsMask1_10.mat", seen)
    savemat(folder / "ObsMask" / "Plane1.mat", {"P": np.array([[0.0], [0], [1], [1]])})
    mesh(folder)
    (folder / "m.ply").rename(folder / "Points" / "stl" / "stl001_total.ply")


def meshes(folder: Path) -> object:
    """A mesh as a surface to compare, and as a result's own."""
    surface = read_surface(folder / "m.ply")
    return surface.areas, surface.face_normals, read_mesh(folder / "m.ply")
