"""A mesh as a program takes it along: into files, and to trimesh."""

import sys

import numpy as np
import pytest

from geogs.errors import InputError
from geogs.mesh.mesh_file import read_mesh
from geogs.mesh.triangle_mesh import Mesh

VERTICES = np.array([[0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 2]], np.float32)
FACES = np.array([[0, 2, 1], [1, 2, 3]], np.int32)


def coloured() -> Mesh:
    mesh = Mesh.from_triangles(VERTICES, FACES)
    colours = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [9, 9, 9]], np.uint8)
    return Mesh(mesh.vertices, mesh.faces, mesh.normals, colours)


def test_the_ending_says_what_file_is_written(tmp_path):
    mesh = coloured()
    for name in ("mesh.ply", "mesh.GLB", "mesh.obj"):
        mesh.save(tmp_path / name)
    again = read_mesh(tmp_path / "mesh.ply")
    for part in Mesh.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(again, part), getattr(mesh, part))
    assert (tmp_path / "mesh.GLB").read_bytes()[:4] == b"glTF"
    assert (tmp_path / "mesh.obj").read_text().count("vn ") == 4
    with pytest.raises(InputError, match=r"should end in \.ply, \.glb, \.obj, \.usdz or \.stl"):
        mesh.save(tmp_path / "mesh.fbx")


def test_trimesh_has_the_same_or_is_said_to_be_missing(monkeypatch):
    pytest.importorskip("trimesh")
    mesh = coloured()
    theirs = mesh.to_trimesh()
    np.testing.assert_array_equal(theirs.faces, FACES)
    np.testing.assert_array_equal(theirs.visual.vertex_colors[:, :3], mesh.colours)
    np.testing.assert_allclose(theirs.vertex_normals, mesh.normals, atol=1e-6)
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(InputError, match="pip install trimesh"):
        mesh.to_trimesh()
