"""Plans, sections, STL, USDZ and cut-out parts of a room that lies askew."""

import re
import zipfile
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geogs.application.export.export import export
from geogs.application.export.region import read_region
from geogs.application.result_settings import ExportSettings, RemeshSettings
from geogs.application.results.revise import remesh
from geogs.cli.main import main
from geogs.config import MeshConfig
from geogs.errors import InputError
from geogs.io.ply_reader import read_ply
from saved_results import make_result
from tilted_room import make_room

ASKEW = Rotation.from_euler("xyz", [70, -40, 20], degrees=True)


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    return make_room(tmp_path_factory.mktemp("room"), ASKEW)


@pytest.fixture(scope="module")
def unscaled(tmp_path_factory) -> Path:
    return make_room(tmp_path_factory.mktemp("unscaled"), ASKEW, scale="arbitrary (monocular)")


@pytest.fixture(scope="module")
def planes(tmp_path_factory) -> Path:
    folder = make_result(tmp_path_factory.mktemp("planes"))
    remesh(RemeshSettings(folder, MeshConfig(voxel=0.15, min_component_faces=10), device="cpu"))
    return folder


def drawn(folder: Path, to: str, path: Path, **more: object) -> Path:
    return export(ExportSettings(folder, to, path, device="cpu", **more))


def dxf_lines(path: Path, layer: str) -> np.ndarray:
    """Both ends of the lines of a layer, read pair by pair."""
    rows = path.read_text().splitlines()
    groups = [(int(code), value) for code, value in zip(rows[::2], rows[1::2], strict=True)]
    starts = [i for i, group in enumerate(groups) if group[0] == 0]
    lines = []
    for start, end in zip(starts, [*starts[1:], len(groups)], strict=True):
        entity = dict(groups[start:end])
        if entity[0] == "LINE" and entity[8] == layer:
            lines.append([[float(entity[10]), float(entity[20])],
                          [float(entity[11]), float(entity[21])]])  # fmt: skip
    return np.array(lines).reshape(-1, 2, 2)


@pytest.mark.parametrize(
    ("to", "true"), [("plan", [4.0, 4.0, 6.0, 6.0]), ("section", [2.4, 2.4, 6.0, 6.0])]
)
def test_drawings_have_the_walls_of_the_room_in_metres(room, tmp_path, to, true):
    path = drawn(room, to, tmp_path / "d.dxf")
    walls = dxf_lines(path, "WALLS")
    lengths = np.sort(np.linalg.norm(walls[:, 1] - walls[:, 0], axis=1))
    np.testing.assert_allclose(lengths, true, atol=0.03)
    svg = drawn(room, to, tmp_path / "d.svg").read_text()
    labels = sorted(float(label) for label in re.findall(r"([0-9.]+) m</text>", svg))
    np.testing.assert_allclose(labels, true, atol=0.03)
    assert re.search(r"1:\d+", svg)
    assert drawn(room, to, tmp_path / "d.pdf").read_bytes().startswith(b"%PDF")


def test_a_drawing_on_paper_has_its_scale(room, tmp_path):
    """At 1:50, six metres are 12 cm, 340.2 points."""
    svg = drawn(room, "plan", tmp_path / "d.svg").read_text()
    scale = int(re.search(r"1:(\d+)", svg)[1])
    points = 72 / 0.0254
    width = float(re.search(r'width="([0-9.]+)pt"', svg)[1])
    assert width == pytest.approx((6 / scale + 0.04) * points, rel=0.01)
    paths = re.findall(r'd="M ([0-9.]+) ([0-9.]+) ?\nL ([0-9.]+) ([0-9.]+)', svg)
    ends = np.array(paths, float).reshape(-1, 2, 2)
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    assert (np.abs(lengths - 6 / scale * points) < 2).sum() == 2


def test_where_metres_are_not_known_lengths_are_in_map_units(unscaled, tmp_path):
    folder = drawn(unscaled, "plan", tmp_path)
    assert sorted(p.name for p in tmp_path.glob("plan.*")) == ["plan.dxf", "plan.pdf", "plan.svg"]
    svg = folder.with_suffix(".svg").read_text()
    assert "lengths in map units" in svg
    assert "m</text>" not in svg
    height = float(re.search(r"Plan, ([0-9.]+) above the floor", svg)[1])
    assert height == pytest.approx(0.8, abs=0.02)  # a third of 2.4


def test_cad_programs_read_the_drawing(room, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    with drawn(room, "plan", tmp_path / "d.dxf").open() as stream:
        path = trimesh.load_path(stream, file_type="dxf")
    lines = [e for e in path.entities if type(e).__name__ == "Line"]
    points = path.vertices[np.concatenate([line.points for line in lines])]
    np.testing.assert_allclose(np.sort(np.ptp(points, axis=0)), [4, 6], atol=0.03)


def test_a_cut_where_there_is_nothing_says_where_floor_and_top_are(room, tmp_path, capsys):
    arguments = ["export", str(room), "--to", "plan", "--cut", "7", "-o", str(tmp_path)]
    assert main([*arguments, "--device", "cpu"]) == 2
    said = capsys.readouterr().err
    assert "the floor is at -1.2" in said
    assert "--cut" in said


@pytest.mark.parametrize("to", ["stl", "obj"])
def test_parts_are_what_lies_in_the_box_or_near_the_camera(room, tmp_path, to):
    trimesh = pytest.importorskip("trimesh")
    up = {"stl": 2, "obj": 1}[to]
    whole = trimesh.load(drawn(room, to, tmp_path / f"w.{to}"), force="mesh")
    np.testing.assert_allclose(np.sort(whole.extents), [2.4, 4, 6], atol=0.05)
    assert whole.extents[up] == pytest.approx(2.4, abs=0.05)
    half = drawn(room, to, tmp_path / f"h.{to}", crop="-9,-9,-0.5,9,9,9")
    half = trimesh.load(half, force="mesh")
    assert half.bounds[0, up] > -0.51
    assert half.bounds[1, up] == pytest.approx(1.2, abs=0.03)
    near = trimesh.load(drawn(room, to, tmp_path / f"n.{to}", crop="near:1.7"), force="mesh")
    distance = np.linalg.norm(near.vertices[:, [i for i in range(3) if i != up]], axis=1)
    assert distance.max() < 0.5 + 1.7 + 0.01
    assert 0.15 < near.area / whole.area < 0.5


def test_stl_stands_with_z_up_and_its_facets_face_inwards(room, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    mesh = trimesh.load(drawn(room, "stl", tmp_path), process=False)
    floor = mesh.triangles_center[:, 2] < -1.15
    assert np.median(mesh.face_normals[floor, 2]) > 0.99
    assert (mesh.face_normals * mesh.triangles_center).sum() < 0


@pytest.mark.parametrize("textured", [True, False])
def test_usdz_is_a_stored_archive_whose_files_begin_at_64_bytes(planes, tmp_path, textured):
    more = {"textured": textured, "texture_size": 256}
    path = drawn(planes, "usdz", tmp_path / "m.usdz", as_tracked=True, **more)
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
        names = ["model.usda", "texture.jpg"] if textured else ["model.usda"]
        assert [entry.filename for entry in entries] == names
        for entry in entries:
            assert entry.compress_type == zipfile.ZIP_STORED
            begin = path.read_bytes().index(archive.read(entry)[:64])
            assert begin % 64 == 0
        model = archive.read("model.usda").decode()
    assert model.startswith("#usda 1.0")
    assert 'upAxis = "Y"' in model
    assert ("@texture.jpg@" in model) == textured
    points = _tuples(model, "points")
    y = read_ply(planes / "mesh.ply")["vertex"].columns["y"]
    found = [points[:, 1].min(), points[:, 1].max()]
    np.testing.assert_allclose(found, [-y.max(), -y.min()], rtol=1e-5)
    corners = re.search(r"faceVertexIndices = \[(.*?)\]", model)[1].split(", ")
    assert max(map(int, corners)) < len(points)
    counts = re.search(r"faceVertexCounts = \[(.*?)\]", model)[1].split(", ")
    assert 3 * len(counts) == len(corners)
    if textured:
        st = _tuples(model, "primvars:st")
        assert len(st) == len(points)
        assert 0 <= st.min() < st.max() <= 1


def _tuples(model: str, name: str) -> np.ndarray:
    rows = re.search(name + r" = \[(.*?)\]", model)[1]
    return np.array([[float(x) for x in row.split(",")] for row in re.findall(r"\((.*?)\)", rows)])


def test_clouds_and_splats_are_cropped_and_paths_are_not(room, tmp_path):
    """The disks lie on planes 7.5 map units from the first keyframe, some of them above it."""
    path = drawn(room, "splats", tmp_path / "s") / "splats_3dgs.ply"
    x = read_ply(path)["vertex"].columns["x"]
    middle = float(np.median(x))
    cropped = drawn(room, "splats", tmp_path / "c", crop=f"{middle},-99,-99,99,99,99")
    kept = read_ply(cropped / "splats_3dgs.ply")["vertex"].columns["x"]
    np.testing.assert_array_equal(kept, x[x >= middle])
    whole = read_ply(drawn(room, "cloud", tmp_path / "w.ply"))["vertex"].columns["x"]
    part = drawn(room, "cloud", tmp_path / "p.ply", crop=f"{middle},-99,-99,99,99,99")
    assert 0 < len(read_ply(part)["vertex"].columns["x"]) < len(whole)
    with pytest.raises(InputError, match="not tum"):
        drawn(room, "tum", tmp_path / "t", crop="near:2")
    with pytest.raises(InputError, match="Nothing of the surface"):
        drawn(room, "glb", tmp_path / "g", crop="90,90,90,99,99,99")


@pytest.mark.parametrize(
    "text", ["1,2,3", "near:", "near:-1", "0,0,0,1,1,0", "far:3", "a,b", "1:2"]
)
def test_other_regions_are_refused(text):
    with pytest.raises(InputError, match="--crop"):
        read_region(text)
