"""The mesh of a result, made anew from its folder."""

import numpy as np
import pytest

import geogs
from geogs.application.result_settings import RemeshSettings
from geogs.application.results.remesh import mesh_settings, remesh
from geogs.application.results.surfaces import fusion_views
from geogs.cli.main import main
from geogs.config import MeshConfig
from geogs.errors import InputError
from geogs.mesh.extract import extract_mesh
from saved_results import BLOCK, ORIGIN, UNIT, WALL, make_result

FINE = MeshConfig(voxel=0.12, min_component_faces=10)


def test_the_mesh_lies_on_the_planes_and_is_read_as_it_was_made(tmp_path):
    folder = make_result(tmp_path)
    path = remesh(RemeshSettings(folder, FINE, device="cpu"))
    assert path == folder / "mesh.ply"
    result = geogs.load_result(folder)
    made, again = extract_mesh(fusion_views(result.keyframes), FINE), result.mesh
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
