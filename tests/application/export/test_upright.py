"""Exports of rooms that lie askew stand upright, whatever the axes of their format."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import geogs
from geogs.application.export.export import export
from geogs.application.result_settings import ExportSettings
from geogs.io.ply_reader import read_ply
from geogs.io.pose_files import read_poses
from tilted_room import make_room

TILTS = [(0, 0, 0), (90, 0, 0), (70, -40, 20), (-100, 10, 170), (15, 0, -12)]
"""Rotations of the rooms' worlds, whose own up is z."""


@pytest.fixture(scope="module", params=TILTS)
def tilted(request, tmp_path_factory) -> tuple[Path, Rotation]:
    turn = Rotation.from_euler("xyz", request.param, degrees=True)
    return make_room(tmp_path_factory.mktemp("room"), turn), turn


def upwards(vertices: np.ndarray) -> np.ndarray:
    """Normal of the lowest part of a room: its floor, by the direction of least extent."""
    middle = vertices - vertices.mean(0)
    return np.linalg.eigh(middle.T @ middle)[1][:, 0]


def test_meshes_stand_as_their_formats_have_it(tilted, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    for to, up in (("glb", 1), ("obj", 1)):
        path = export(ExportSettings(tilted[0], to, tmp_path, device="cpu", textured=False))
        found = upwards(trimesh.load(path, process=False, force="mesh").vertices)
        assert abs(found[up]) > np.cos(np.radians(0.2)), to


def test_paths_poses_and_disks_turn_with_the_room(tilted, tmp_path):
    folder, turn = tilted
    result = geogs.load_result(folder)
    for to, up in (("tum", [0, 0, 1]), ("kitti", [0, -1, 0]), ("splats", [0, -1, 0])):
        path = export(ExportSettings(folder, to, tmp_path / to, device="cpu"))
        if to == "splats":
            v = read_ply(path / "splats_3dgs.ply")["vertex"].columns
            after = np.stack([v[axis] for axis in "xyz"], -1).astype(float)
            before = result.disks.position.double().numpy()
        else:
            after = read_poses(path).T_wc[:, :3, 3]
            before = result.trajectory.T_wc[:, :3, 3]
        R, error = Rotation.align_vectors(after - after[0], before - before[0])
        assert error < 1e-3 * np.linalg.norm(before - before[0]), to
        assert R.apply(turn.apply([0, 0, 1])) @ up > np.cos(np.radians(0.2)), to


def test_image_sets_turn_as_a_whole(tilted, tmp_path):
    """Depth of the rotated map is that of the map: cameras and disks were turned alike."""
    folder, _ = tilted
    depth = []
    for as_tracked in (True, False):
        settings = ExportSettings(
            folder, "depth", tmp_path / str(as_tracked), as_tracked, device="cpu"
        )
        depth.append(np.load(export(settings) / "000002.npz")["depth"])
    np.testing.assert_allclose(*depth, atol=2e-3)
    said = json.loads((tmp_path / "True" / "description.json").read_text())
    tracked = geogs.load_result(folder).views.T_cw[1]
    np.testing.assert_allclose(said["T_cw"]["000002"], tracked)
    turned = json.loads((tmp_path / "False" / "description.json").read_text())["T_cw"]["000002"]
    if tilted[1].magnitude() > 0.1:
        assert np.abs(np.array(turned) - tracked).max() > 0.05
