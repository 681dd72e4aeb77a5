"""What is written can be read again, by us and by the programs it is meant for."""

import json

import numpy as np
import pytest
import torch

from geogs.errors import InputError, OutputError
from geogs.geometry.lie import quaternion_to_matrix, se3_exp
from geogs.guard.atomic import atomic_file, prepare_output_folder, write_text
from geogs.io.ply_reader import read_ply
from geogs.io.pose_files import read_tum_trajectory
from geogs.io.writers.map_file import load_map, save_map
from geogs.io.writers.ply_writer import SPLAT_THICKNESS, write_mesh, write_splats
from geogs.io.writers.trajectories import write_tum_trajectory
from geogs.types import MapSnapshot, Trajectory

TETRAHEDRON = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=np.float32)
TRIANGLES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


@pytest.fixture
def disks() -> MapSnapshot:
    generator = torch.Generator().manual_seed(0)
    quaternion = torch.randn(50, 4, generator=generator)
    return MapSnapshot(
        position=torch.randn(50, 3, generator=generator),
        quaternion=quaternion / quaternion.norm(dim=1, keepdim=True),
        scale=torch.rand(50, 2, generator=generator) * 0.1 + 0.001,
        opacity=torch.rand(50, generator=generator) * 0.98 + 0.01,
    )


def test_trajectory_round_trip_is_exact_to_rounding(tmp_path):
    generator = torch.Generator().manual_seed(1)
    T_wc = se3_exp(3 * torch.randn(40, 6, generator=generator, dtype=torch.float64)).numpy()
    times = 1305031102.175304 + np.arange(40) / 30
    tracked = np.arange(40) % 7 != 0
    write_tum_trajectory(tmp_path / "t.tum", Trajectory(times, T_wc, tracked))
    read = read_tum_trajectory(tmp_path / "t.tum")
    np.testing.assert_array_equal(read.timestamps, times)
    np.testing.assert_array_equal(read.T_wc[:, :3, 3], T_wc[:, :3, 3])
    np.testing.assert_allclose(read.T_wc[:, :3, :3], T_wc[:, :3, :3], atol=1e-14)


def test_trajectory_is_read_the_same_by_evo(tmp_path):
    file_interface = pytest.importorskip("evo.tools.file_interface")
    generator = torch.Generator().manual_seed(2)
    T_wc = se3_exp(torch.randn(6, 6, generator=generator, dtype=torch.float64)).numpy()
    write_tum_trajectory(
        tmp_path / "t.tum", Trajectory(np.arange(6) / 30, T_wc, np.ones(6, dtype=bool))
    )
    evo = file_interface.read_tum_trajectory_file(str(tmp_path / "t.tum"))
    np.testing.assert_allclose(evo.poses_se3, T_wc, atol=1e-14)
    np.testing.assert_array_equal(evo.timestamps, np.arange(6) / 30)


def test_empty_trajectory_is_a_header(tmp_path):
    empty = Trajectory(np.zeros(0), np.zeros((0, 4, 4)), np.zeros(0, dtype=bool))
    write_tum_trajectory(tmp_path / "t.tum", empty)
    assert (tmp_path / "t.tum").read_text() == "# timestamp tx ty tz qx qy qz qw\n"


def test_coloured_mesh_is_read_by_trimesh(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    colors = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [9, 8, 7]], dtype=np.uint8)
    normals = TETRAHEDRON - 0.25
    write_mesh(tmp_path / "mesh.ply", TETRAHEDRON, TRIANGLES, colors, normals)
    mesh = trimesh.load(tmp_path / "mesh.ply", process=False)
    np.testing.assert_array_equal(mesh.vertices, TETRAHEDRON)
    np.testing.assert_array_equal(mesh.faces, TRIANGLES)
    np.testing.assert_array_equal(mesh.visual.vertex_colors[:, :3], colors)
    vertex = read_ply(tmp_path / "mesh.ply")["vertex"].columns
    np.testing.assert_array_equal(vertex["nz"], normals[:, 2])


def test_mesh_without_colours_or_faces(tmp_path):
    write_mesh(tmp_path / "mesh.ply", TETRAHEDRON, TRIANGLES[:0])
    ply = read_ply(tmp_path / "mesh.ply")
    assert len(ply["vertex"].columns["x"]) == 4
    assert len(ply["face"].lists["vertex_indices"].lengths) == 0
    assert list(ply["vertex"].columns) == ["x", "y", "z"]


def test_splats_have_the_layout_that_viewers_expect(tmp_path, disks):
    colors = np.random.default_rng(0).random((50, 3))
    write_splats(tmp_path / "splats.ply", disks, colors)
    assert b"\nformat binary_little_endian 1.0\n" in (tmp_path / "splats.ply").read_bytes()[:60]
    vertex = read_ply(tmp_path / "splats.ply")["vertex"].columns
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity",
             "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]  # fmt: skip
    assert list(vertex) == names
    assert {column.dtype for column in vertex.values()} == {np.dtype("f4")}

    def column(prefix: str, count: int) -> torch.Tensor:
        return torch.from_numpy(np.stack([vertex[f"{prefix}_{i}"] for i in range(count)], 1))

    # Decoded as the viewers do it.
    torch.testing.assert_close(torch.sigmoid(torch.from_numpy(vertex["opacity"])), disks.opacity)
    torch.testing.assert_close(column("scale", 2).exp(), disks.scale)
    thin = SPLAT_THICKNESS * disks.scale.min(dim=1).values
    torch.testing.assert_close(column("scale", 3)[:, 2].exp(), thin)
    torch.testing.assert_close(column("rot", 4), disks.quaternion)
    np.testing.assert_allclose(0.5 + 0.28209479 * column("f_dc", 3).numpy(), colors, atol=1e-6)
    normal = torch.from_numpy(np.stack([vertex["nx"], vertex["ny"], vertex["nz"]], 1))
    torch.testing.assert_close(normal, quaternion_to_matrix(disks.quaternion)[..., 2])


def test_splats_stay_finite_at_extreme_values(tmp_path):
    extreme = MapSnapshot(
        position=torch.zeros(2, 3),
        quaternion=torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1),
        scale=torch.tensor([[0.0, 1.0], [1e-20, 1e-20]]),
        opacity=torch.tensor([0.0, 1.0]),
    )
    write_splats(tmp_path / "s.ply", extreme, np.zeros((2, 3)))
    vertex = read_ply(tmp_path / "s.ply")["vertex"].columns
    assert all(np.isfinite(column).all() for column in vertex.values())


def test_empty_map_can_be_written(tmp_path, disks):
    none = MapSnapshot(disks.position[:0], disks.quaternion[:0], disks.scale[:0], disks.opacity[:0])
    write_splats(tmp_path / "s.ply", none, np.zeros((0, 3)))
    assert len(read_ply(tmp_path / "s.ply")["vertex"].columns["x"]) == 0
    save_map(tmp_path / "m.safetensors", none)
    assert len(load_map(tmp_path / "m.safetensors")) == 0


def test_map_round_trip_is_exact_and_ten_floats_a_disk(tmp_path, disks):
    path = tmp_path / "map.safetensors"
    metadata = {"scene": "room", "unit": "of the sequence", "views": [1, 2]}
    save_map(path, disks, metadata)
    read = load_map(path)
    for name in ("position", "quaternion", "scale", "opacity"):
        assert torch.equal(getattr(read, name), getattr(disks, name))
    header = int.from_bytes(path.read_bytes()[:8], "little")
    assert path.stat().st_size == 8 + header + 50 * 10 * 4
    declared = json.loads(path.read_bytes()[8 : 8 + header])["__metadata__"]
    assert (declared["format"], declared["version"]) == ("geogs-map", "1")
    assert json.loads(declared["metadata"]) == metadata


def test_maps_that_cannot_be_used(tmp_path, disks):
    path = tmp_path / "map.safetensors"
    with pytest.raises(InputError, match="does not exist"):
        load_map(path)
    path.write_bytes(b"not a map at all, certainly")
    with pytest.raises(InputError, match="damaged"):
        load_map(path)
    save_map(path, disks)
    whole = path.read_bytes()
    path.write_bytes(whole[:-100])
    with pytest.raises(InputError, match="damaged"):
        load_map(path)
    path.write_bytes(whole.replace(b'"version":"1"', b'"version":"9"'))
    with pytest.raises(InputError, match="newer geogs"):
        load_map(path)
    path.write_bytes(whole.replace(b"geogs-map", b"other-map"))
    with pytest.raises(InputError, match="no map of geogs"):
        load_map(path)
    disks.position[3, 1] = torch.nan
    save_map(path, disks)
    with pytest.raises(InputError, match="NaN"):
        load_map(path)


def test_interrupted_write_keeps_the_former_file(tmp_path):
    path = tmp_path / "a" / "b" / "file.txt"
    write_text(path, "first")

    def interrupted() -> None:
        with atomic_file(path) as stream:
            stream.write(b"half")
            assert path.read_text() == "first"
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_text() == "first"
    assert list(path.parent.iterdir()) == [path]
    write_text(path, "second")
    assert path.read_text() == "second"


def test_output_folder_is_made_and_probed(tmp_path):
    folder = prepare_output_folder(tmp_path / "new" / "out")
    assert folder.is_dir()
    assert list(folder.iterdir()) == []
    (folder / ".writable").write_text("of somebody else")
    assert [path.name for path in prepare_output_folder(folder).iterdir()] == [".writable"]
    assert (folder / ".writable").read_text() == "of somebody else"
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="is a file; give another folder"):
        prepare_output_folder(tmp_path / "file")
    with pytest.raises(OutputError, match="cannot be written"):
        prepare_output_folder(tmp_path / "file" / "out")
