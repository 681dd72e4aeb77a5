"""PLY files of every form come out alike; damaged ones end in one sentence."""

import contextlib
from pathlib import Path

import numpy as np
import pytest

from geogs.errors import InputError
from geogs.io import ply_reader as ply_module
from geogs.io.ply_reader import read_ply
from geogs.io.writers.ply_writer import write_mesh, write_points

POINTS = np.array([[0.1, -2.5, 3e7], [1, 2, 3], [-0.0, 5, 6], [7, 8, 9]], np.float32)
HEADER = (
    "ply\nformat {} 1.0\ncomment of nobody\nelement vertex 4\nproperty float x\n"
    "property float y\nproperty float z\nproperty uchar red\nelement camera 1\n"
    "property double fx\nproperty list ushort short pixels\nelement face {}\n"
    "property uint label\nproperty list uchar int vertex_indices\nproperty int8 flags\nend_header\n"
)
RED = (0, 255, 7, 128)
TRIANGLES, POLYGONS = [[0, 1, 2], [0, 2, 3]], [[0, 1, 2, 3], [], [0, 2, 3], [1]]


def encoded(form: str, faces: list[list[int]]) -> bytes:
    """A file of three elements, written number by number."""
    if form == "ascii":
        rows = [f"{x!r} {y!r} {z!r} {r}" for (x, y, z), r in zip(POINTS.tolist(), RED, strict=True)]
        rows += ["525.25 2 -7 300"]
        rows += [
            f"{4000000000 + i} {len(f)} {' '.join(map(str, f))} {-i}" for i, f in enumerate(faces)
        ]
        return (HEADER.format(form, len(faces)) + "\n".join(rows) + "\n").encode()
    order = "<" if "little" in form else ">"
    body = b""

    def put(kind: str, *numbers: float) -> bytes:
        return np.array(numbers, order + kind).tobytes()

    for point, red in zip(POINTS, RED, strict=True):
        body += put("f4", *point) + put("u1", red)
    body += put("f8", 525.25) + put("u2", 2) + put("i2", -7, 300)
    for i, face in enumerate(faces):
        body += put("u4", 4000000000 + i) + put("u1", len(face)) + put("i4", *face) + put("i1", -i)
    return HEADER.format(form, len(faces)).encode() + body


@pytest.mark.parametrize("faces", [TRIANGLES, POLYGONS, []], ids=["triangles", "polygons", "none"])
@pytest.mark.parametrize("newline", [b"\n", b"\r\n"], ids=["unix", "dos"])
@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_every_form_says_the_same(tmp_path: Path, form: str, newline: bytes, faces) -> None:
    data = encoded(form, faces)
    header, body = data.split(b"end_header\n")
    path = tmp_path / "a.ply"
    path.write_bytes(header.replace(b"\n", newline) + b"end_header" + newline + body)
    ply = read_ply(path)
    assert list(ply) == ["vertex", "camera", "face"]
    vertex, camera, face = ply.values()
    for column, expected in zip(vertex.columns.values(), POINTS.T, strict=False):
        assert column.dtype == np.float32
        np.testing.assert_array_equal(column, expected)
    assert vertex.columns["red"].tolist() == list(RED)
    assert camera.columns["fx"].tolist() == [525.25]
    assert camera.lists["pixels"].values.tolist() == [-7, 300]
    assert face.lists["vertex_indices"].lengths.tolist() == [len(f) for f in faces]
    assert face.lists["vertex_indices"].values.tolist() == [k for f in faces for k in f]
    assert face.lists["vertex_indices"].values.dtype == np.int32
    assert face.columns["label"].tolist() == [4000000000 + i for i in range(len(faces))]
    assert face.columns["flags"].tolist() == [-i for i in range(len(faces))]


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("faces", [TRIANGLES, POLYGONS], ids=["triangles", "polygons"])
def test_a_file_cut_off_anywhere_is_an_input_error(tmp_path: Path, form: str, faces) -> None:
    data = encoded(form, faces)
    ends = range(len(data)) if form != "ascii" else range(data.rindex(b" "))
    path = tmp_path / "a.ply"
    for end in ends:
        path.write_bytes(data[:end])
        with pytest.raises(InputError, match=r"a\.ply is no readable PLY file"):
            read_ply(path)


def test_any_changed_byte_is_read_or_an_input_error(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    path = tmp_path / "a.ply"
    for form in ("ascii", "binary_little_endian"):
        data = encoded(form, POLYGONS)
        for _ in range(300):
            changed = bytearray(data)
            changed[rng.integers(len(data))] = rng.integers(256)
            path.write_bytes(changed)
            with contextlib.suppress(InputError):
                read_ply(path)


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("ply\n", "stl\n", "no header"),
        ("format ascii 1.0\n", "", "header says 'property float x'"),
        ("ascii", "binary_middle_endian", "header says 'format"),
        ("element vertex 4", "element vertex -4", "header says 'element"),
        ("element vertex 4", "element vertex 9999999999999999", "rows of vertex are not there"),
        ("element face", "element vertex", "header says 'element vertex"),
        ("property float y", "property float x", "x is there twice"),
        ("property float y", "property half y", "type of the property y is 'half'"),
        ("list uchar int", "list float int", "type of the property vertex_indices"),
        ("3 0 1 2 0", "-3 0 1 2 0", "has length -3"),
        ("3 0 1 2 0", "nan 0 1 2 0", "no readable PLY"),
        ("3 0 1 2 0", "1e99 0 1 2 0", "no readable PLY"),
        ("3 0 1 2 0", "3 0 1.5 2 0", "vertex_indices holds what is no int32"),
        ("3 0 1 2 0", "3 0 x 2 0", "could not convert"),
        (" 255", " 256", "red holds what is no uint8"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said(tmp_path: Path, old: str, new: str, match: str) -> None:
    text = encoded("ascii", TRIANGLES).decode()
    assert old in text
    path = tmp_path / "a.ply"
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=match):
        read_ply(path)


def test_missing_files_and_folders_are_input_errors(tmp_path: Path) -> None:
    for path in (tmp_path / "none.ply", tmp_path):
        with pytest.raises(InputError, match="does not exist"):
            read_ply(path)


def test_a_large_mesh_is_read_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Triangles are never walked over one by one, and what is read is what was written."""
    walk = ply_module._walk

    def of_one_row(data, start, count, properties):
        assert count == 1
        return walk(data, start, count, properties)

    monkeypatch.setattr(ply_module, "_walk", of_one_row)
    rng = np.random.default_rng(0)
    vertices = rng.random((100_000, 3), np.float32)
    faces = rng.integers(0, len(vertices), (200_000, 3))
    colours = rng.integers(0, 256, vertices.shape, np.uint8)
    write_mesh(tmp_path / "m.ply", vertices, faces, colours, vertices)
    ply = read_ply(tmp_path / "m.ply")
    np.testing.assert_array_equal(ply["face"].lists["vertex_indices"].values, faces.reshape(-1))
    np.testing.assert_array_equal(ply["vertex"].columns["nz"], vertices[:, 2])
    np.testing.assert_array_equal(ply["vertex"].columns["green"], colours[:, 1])
    write_points(tmp_path / "p.ply", vertices)
    assert list(read_ply(tmp_path / "p.ply")) == ["vertex"]


def test_trimesh_writes_what_we_read(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    mesh = trimesh.creation.icosphere(subdivisions=2)
    for encoding in ("ascii", "binary"):
        mesh.export(tmp_path / "t.ply", encoding=encoding)
        ply = read_ply(tmp_path / "t.ply")
        vertices = np.stack([ply["vertex"].columns[axis] for axis in "xyz"], 1)
        np.testing.assert_allclose(vertices, mesh.vertices, atol=1e-7)
        corners = ply["face"].lists["vertex_indices"].values.reshape(-1, 3)
        np.testing.assert_array_equal(corners, mesh.faces)
