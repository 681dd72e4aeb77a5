"""A saved result brought to metres, or given another mesh."""

import json
import re
import shlex

import numpy as np
import pytest

import geogs
from disk_faults import contents
from geogs.application.checkpoints.checkpoint import checkpoint_folder
from geogs.application.checkpoints.run_state import RunState
from geogs.application.export.export import EXPORTS, export
from geogs.application.reconstruct import ReconstructState
from geogs.application.rescale import rescale
from geogs.application.result_settings import ExportSettings, RemeshSettings, RescaleSettings
from geogs.application.results.revise import mesh_settings, remesh
from geogs.application.results.surfaces import fusion_views
from geogs.cli.main import main
from geogs.config import MeshConfig
from geogs.errors import InputError
from geogs.guard.atomic import write_text
from geogs.guard.replacement import replaced
from geogs.io.ply_reader import read_ply
from geogs.io.pose_files import read_tum_trajectory
from geogs.io.writers.intrinsics_file import write_intrinsics
from geogs.io.writers.map_file import save_map
from geogs.io.writers.ply_writer import write_splats
from geogs.mesh.extract import extract_mesh
from geogs.world.kinds import schema
from saved_results import BLOCK, CAMERA, ORIGIN, UNIT, WALL, make_result

FINE = MeshConfig(voxel=0.12, min_component_faces=10)
METRES = 1.5


@pytest.fixture
def folder(tmp_path):
    """A result with everything in it."""
    folder = make_result(tmp_path)
    disks = geogs.load_result(folder).disks
    write_splats(folder / "splats.ply", disks, np.full((len(disks), 3), 0.25))
    write_intrinsics(folder / "intrinsics.json", CAMERA)
    remesh(RemeshSettings(folder, FINE, device="cpu"))
    (folder / "summary.json").write_text('{"source": "planes", "scale": "arbitrary", "frames": 5}')
    (folder / "trajectory_uncertainty.csv").write_text(
        "timestamp,state,sigma_position,sigma_rotation_deg,relative_sigma_depth\n"
        "0.0,tracked,0.02,0.1,0.01\n0.1,lost,,,\n"
    )
    return folder


def test_every_length_is_multiplied(folder):
    # Two pixels of the wall in the first frame, of which the depth is known.
    u, v = (8.0, 70.0), (6.0, 52.0)
    x = [(c - CAMERA.cx) / CAMERA.fx * WALL * UNIT for c in u]
    y = [(r - CAMERA.cy) / CAMERA.fy * WALL * UNIT for r in v]
    units = float(np.hypot(x[1] - x[0], y[1] - y[0]))
    before = geogs.load_result(folder)
    poses, keyframe = before.trajectory.T_wc, before.keyframes[1]
    depth, vertices = keyframe.depth, before.mesh.vertices
    splats = read_ply(folder / "splats.ply")["vertex"].columns
    known = f"0:{u[0]},{v[0]},{u[1]},{v[1]}={METRES * units}"
    found = rescale(RescaleSettings(folder, known, "cpu"))
    assert found.factor == pytest.approx(METRES, rel=0.01)
    after = geogs.load_result(folder)
    np.testing.assert_allclose(after.trajectory.T_wc[:, :3, 3], found.factor * poses[:, :3, 3])
    np.testing.assert_allclose(after.trajectory.T_wc[:, :3, :3], poses[:, :3, :3], atol=1e-12)
    np.testing.assert_allclose(after.keyframes[1].depth, found.factor * depth, rtol=1e-4)
    np.testing.assert_allclose(after.mesh.vertices, found.factor * vertices, rtol=1e-5)
    scaled = read_ply(folder / "splats.ply")["vertex"].columns
    np.testing.assert_allclose(scaled["x"], found.factor * splats["x"], rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(
        scaled["scale_0"], splats["scale_0"] + np.log(found.factor), atol=1e-4
    )
    np.testing.assert_allclose(scaled["f_dc_1"], splats["f_dc_1"], atol=1e-5)
    table = (folder / "trajectory_uncertainty.csv").read_text().splitlines()
    assert float(table[1].split(",")[2]) == pytest.approx(0.02 * found.factor, rel=1e-4)
    assert table[2] == "0.1,lost,,,"
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["scale"] == "metric (a known distance)"
    assert summary["metric_scale"]["factor"] == found.factor
    again = rescale(RescaleSettings(folder, known, "cpu"))
    assert again.factor == pytest.approx(1, abs=1e-4)
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["metric_scale"]["factor"] == pytest.approx(found.factor, rel=1e-3)
    assert len(read_tum_trajectory(folder / "trajectory.tum").timestamps) == 5


KNOWN = "0:8,6,70,52=13.8m"
"""A length in the first frame, which about doubles all others."""
WITHOUT_LENGTHS = re.compile(r"config.yaml|intrinsics.json|keyframes/.*|\.geogs.*")


def test_nothing_of_the_old_unit_is_left(folder):
    """Every file but those without lengths is written anew or gone."""
    (folder / "report").mkdir()
    with replaced(folder, "part") as new:
        for name in ("eval.json", "report/mesh_truth.png", "report/trajectory.png"):
            write_text(new / name, "old")
        seconds = "snapshots/5"
        (new / seconds).mkdir(parents=True)
        save_map(new / seconds / "map.safetensors", geogs.load_result(folder).disks, {"seconds": 5})
        geogs.load_result(folder).mesh.save(new / seconds / "mesh.ply")
    more: dict[str, dict[str, object]] = {
        "glb": {"textured": False},
        "tum": {},
        "stl": {"crop": "near:9"},
        "cloud": {"as_tracked": True},
        "section": {"cut": 5.0},
    }
    for to, options in more.items():
        export(ExportSettings(folder, to, device="cpu", **options))
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    vertices = geogs.load_result(folder).mesh.vertices
    cloud = np.ptp(read_ply(folder / "export/cloud/cloud.ply")["vertex"].columns["x"])
    triangles = (folder / "export/stl/mesh.stl").stat().st_size
    factor = rescale(RescaleSettings(folder, KNOWN, "cpu")).factor
    assert factor == pytest.approx(2, rel=0.2)
    same = [
        str(path.relative_to(folder))
        for path, data in before.items()
        if path.is_file() and path.read_bytes() == data
    ]
    assert [name for name in same if not WITHOUT_LENGTHS.fullmatch(name)] == []
    gone = {path.name for path in before if not path.is_file()}
    assert gone == {"eval.json", "mesh_truth.png"}
    after = read_ply(folder / "export/cloud/cloud.ply")["vertex"].columns["x"]
    assert np.ptp(after) == pytest.approx(factor * cloud, rel=0.01)
    assert (folder / "export/stl/mesh.stl").stat().st_size == triangles  # cropped as before
    path = read_tum_trajectory(folder / "export/tum/trajectory.txt")
    assert np.isclose(np.linalg.norm(path.T_wc[0, :3, 3]), factor * np.linalg.norm(ORIGIN))
    snapshot = read_ply(folder / "snapshots/5/mesh.ply")["vertex"].columns["x"]
    np.testing.assert_allclose(snapshot, factor * vertices[:, 0], rtol=1e-5)
    recorded = json.loads((folder / EXPORTS).read_text())
    assert recorded["export/section/section.svg"]["cut"] == pytest.approx(5 * factor)
    assert recorded["export/glb/mesh.glb"]["textured"] is False


@pytest.mark.parametrize(
    "listed", ["[]", '{"a": 3}', '{"export/tum/trajectory.txt": {"to": []}}', "x"]
)
def test_a_damaged_list_of_exports_is_an_error_in_a_sentence(folder, listed, capsys):
    export(ExportSettings(folder, "tum", device="cpu"))
    (folder / EXPORTS).write_text(listed)
    assert main(["scale", str(folder), "--from", KNOWN, "--device", "cpu"]) == 2
    assert EXPORTS in capsys.readouterr().err
    assert json.loads((folder / "summary.json").read_text())["scale"] == "arbitrary"


@pytest.mark.parametrize("name", ["out", "my out"])
@pytest.mark.parametrize(
    ("state", "command"),
    [
        (RunState, f"geogs run --resume {{}} --scale-from {KNOWN} finishes it in metres."),
        (ReconstructState, "geogs reconstruct --resume {}, with its source and settings."),
    ],
)
def test_what_is_unfinished_names_the_command_that_finishes_it(
    tmp_path, capsys, state, command, name
):
    """In metres at once where that command can do that."""
    folder = make_result(tmp_path / name)
    before = contents(folder)
    with checkpoint_folder(folder).replaced(schema(state), {}) as write:
        write("json", b"{}")
    assert main(["scale", str(folder), "--from", KNOWN, "--device", "cpu"]) == 2
    assert command.format(shlex.quote(str(folder))) in capsys.readouterr().err
    assert before.items() <= contents(folder).items()


def test_what_cannot_be_scaled_stays_as_it_is(folder, capsys):
    with pytest.raises(InputError, match="Nothing is known"):
        rescale(RescaleSettings(folder, "", "cpu"))
    with pytest.raises(InputError, match="no tag of DICT_5X5_50 was found"):
        rescale(RescaleSettings(folder, "aruco:DICT_5X5_50:0.1", "cpu"))
    assert json.loads((folder / "summary.json").read_text())["scale"] == "arbitrary"
    assert main(["scale", str(folder), "--from", "0:1", "--device", "cpu"]) == 2
    assert "is not understood" in capsys.readouterr().err


def test_the_mesh_lies_on_the_planes_and_is_read_as_it_was_made(tmp_path):
    folder = make_result(tmp_path)
    path = remesh(RemeshSettings(folder, FINE, device="cpu"))
    assert path == folder / "mesh.ply"
    result = geogs.load_result(folder)
    made, again = extract_mesh(fusion_views(result.renders), FINE), result.mesh
    for name in ("vertices", "faces", "normals", "colours"):
        np.testing.assert_array_equal(getattr(made, name), getattr(again, name))
    z = (again.vertices[:, 2] - ORIGIN[2]) / UNIT
    assert np.median(np.minimum(np.abs(z - WALL), np.abs(z - BLOCK))) < 0.01


def test_the_command_takes_the_settings_of_the_run_where_none_are_given(tmp_path, capsys):
    folder = make_result(tmp_path)
    text = (folder / "config.yaml").read_text()
    (folder / "config.yaml").write_text(text.replace("  voxel: null", "  voxel: 0.2"))
    assert mesh_settings(folder).voxel == 0.2
    assert main(["mesh", str(folder), "--mesh.detail", "0", "-o", str(tmp_path / "a.ply")]) == 0
    assert "a.ply" in capsys.readouterr().out
    assert main(["mesh", str(folder), "-o", str(tmp_path / "a.glb")]) == 2
    assert "geogs export" in capsys.readouterr().err
    (folder / "config.yaml").write_text("mesh: 3")
    with pytest.raises(InputError, match=r"config.yaml is damaged"):
        mesh_settings(folder)
    assert mesh_settings(tmp_path / "nowhere") == MeshConfig()


def test_the_page_shows_the_mesh_that_was_made_anew(tmp_path):
    folder = make_result(tmp_path)
    assert remesh(RemeshSettings(folder, FINE, device="cpu")) == folder / "mesh.ply"
    assert not (folder / "report").exists()  # of a result without a page none is made
    (folder / "summary.json").write_text('{"source": "planes", "mesh_faces": 7, "frames": 5}')
    (folder / "report").mkdir()
    remesh(RemeshSettings(folder, FINE, device="cpu"))
    page = (folder / "report" / "index.html").read_text()
    faces = f"{len(geogs.load_result(folder).mesh.faces):,}".replace(",", " ")
    assert f"<dt>triangles</dt><dd>{faces}</dd>" in page
    assert 'id="model-arrays"' in page
