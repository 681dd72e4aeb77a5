"""Scenes are found in generated small copies of every data set's layout."""

from pathlib import Path

import numpy as np
import pytest

from flat_rooms import SIZE, flat_room
from geogs.errors import InputError
from geogs.io.sources.sniff import open_source
from geogs_bench.bench import BENCHMARKS, find_benchmark
from geogs_bench.data.benchmark_scene import Option
from geogs_bench.data.scenes import (
    find_any_posed,
    find_dtu,
    find_objects,
    find_posed_rooms,
    find_relighted,
    find_replica,
    find_rooms,
    find_scannet,
    find_scannetpp,
    find_seven_scenes,
    find_tum,
)
from geogs_bench.data.true_poses import read_true_poses
from geogs_bench.plan import find_scenes
from io_samples import write_images
from posed_layouts import write_colmap_text, write_dtu, write_scannet


def replica_scene(folder: Path, frames: int = 3) -> Path:
    write_images(folder / "results", [f"frame{i:06d}.jpg" for i in range(frames)], *SIZE)
    np.savetxt(folder / "traj.txt", np.tile(np.eye(4), (frames, 1, 1)).reshape(-1, 16))
    return folder


def touch(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    return path


def test_replica_takes_the_culled_mesh_where_there_is_one(tmp_path):
    for name in ("room0", "office1", "office0"):
        replica_scene(tmp_path / name)
    touch(tmp_path / "room0_mesh.ply")
    touch(tmp_path / "office0_mesh.ply")
    culled = touch(tmp_path / "cull_replica_mesh" / "room0.ply")
    scenes = {scene.name: scene for scene in find_replica(tmp_path)}
    assert list(scenes) == ["office0", "office1", "room0"]
    assert scenes["room0"].truth.surface == culled
    assert scenes["room0"].truth.culling == "done"
    assert scenes["office0"].truth.culling == "frustum"
    assert scenes["office1"].truth.surface is None
    assert [s.name for s in find_replica(tmp_path.parent / tmp_path.name / "room0")] == ["room0"]


def test_only_the_scenes_of_the_paper_run_unless_others_are_named(tmp_path):
    for name in ("room0", "office1", "attic"):
        replica_scene(tmp_path / name)
    replica = BENCHMARKS["replica"]
    assert [s.name for s in find_scenes(replica, tmp_path)] == ["room0", "office1"]
    assert [s.name for s in find_scenes(replica, tmp_path, ["attic"])] == ["attic"]
    with pytest.raises(InputError, match="no scene cellar, only attic, office1, room0"):
        find_scenes(replica, tmp_path, ["cellar"])
    with pytest.raises(InputError, match=r"no scene of tum, which needs .*rgb\.txt"):
        find_scenes(BENCHMARKS["tum"], tmp_path)


def test_rooms_objects_and_light(tmp_path):
    for name in ("hall", "hall-light", "bare"):
        replica_scene(tmp_path / name)
    touch(tmp_path / "hall" / "mesh.ply")
    seen = touch(tmp_path / "hall" / "points_seen_1cm.ply")
    rooms = find_rooms(tmp_path)
    assert [s.name for s in rooms] == ["hall", "hall-light"]
    assert rooms[1].truth.points == seen
    assert rooms[1].truth.poses == tmp_path / "hall-light" / "traj.txt"
    assert [s.name for s in find_relighted(tmp_path)] == ["hall", "hall-light"]
    jug = replica_scene(tmp_path / "objects" / "jug")
    touch(jug / "mesh_object.ply")
    touch(jug / "results" / "mask000000.png")
    (scene,) = find_objects(tmp_path)
    assert (scene.name, scene.kind) == ("jug", "object")
    assert [s.name for s in find_any_posed(tmp_path)] == ["jug"]


def test_known_poses_use_about_a_hundred_images(tmp_path):
    touch(replica_scene(tmp_path / "long", 250) / "mesh.ply")
    touch(replica_scene(tmp_path / "short", 3) / "mesh.ply")
    options = {scene.name: scene.options for scene in find_posed_rooms(tmp_path)}
    assert options["long"][-1] == Option("input.stride", "2")
    assert options["short"][-1] == Option("input.stride", "1")


def test_scannet_poses_follow_the_numbers_of_the_images(tmp_path):
    scene = tmp_path / "scans" / "scene0000_00"
    scene.mkdir(parents=True)
    write_scannet(flat_room(4), scene)
    (scene / "pose" / "1.txt").write_text("-inf " * 16)
    (scene / "color" / "2.png").unlink()
    (found,) = find_scannet(tmp_path)
    assert found.source == scene / "color"
    calibration = str(scene / "intrinsic" / "intrinsic_color.txt")
    assert found.options == (Option("input.intrinsics", calibration),)
    poses = read_true_poses(found)
    # There is no image 2, and image 1 has no pose.
    np.testing.assert_allclose(poses.timestamps, [0, 3 / 30])
    assert {frame.timestamp for frame in open_source(found.source)} >= {*poses.timestamps}
    np.testing.assert_allclose(poses.T_wc[:, 0, 3], [0, -3])


def test_scannetpp_frames_as_images_or_video(tmp_path):
    room = flat_room(4)
    phone = tmp_path / "data" / "8b5caf3398" / "iphone"
    names = [f"frame_{10 * i:06d}.jpg" for i in range(4)]
    write_images(phone / "rgb", names, *SIZE)
    write_colmap_text(room, phone / "colmap", [f"video/{name}" for name in names])
    mesh = touch(phone.parent / "scans" / "mesh_aligned_0.05.ply")
    (scene,) = find_scannetpp(tmp_path)
    assert (scene.name, scene.source, scene.truth.surface) == ("8b5caf3398", phone / "rgb", mesh)
    assert Option("input.stride", "2") in scene.options
    times = read_true_poses(scene).timestamps
    np.testing.assert_allclose(times, 10 * np.arange(4) / 60)
    assert [frame.timestamp for frame in open_source(scene.source)] == times.tolist()
    for name in names:
        (phone / "rgb" / name).unlink()
    video = touch(phone / "rgb.mkv")
    (scene,) = find_scannetpp(tmp_path / "data")
    assert scene.source == video
    np.testing.assert_allclose(read_true_poses(scene).timestamps, 10 * np.arange(4) / 60)


def test_tum_and_seven_scenes(tmp_path):
    desk = tmp_path / "tum" / "rgbd_dataset_freiburg1_desk"
    touch(desk / "rgb.txt")
    touch(desk / "groundtruth.txt")
    touch(tmp_path / "tum" / "rgbd_dataset_freiburg1_xyz" / "rgb.txt")
    (found,) = find_tum(tmp_path / "tum")
    assert (found.name, found.has_depth) == (desk.name, False)
    touch(desk / "depth.txt")
    assert find_tum(desk)[0].has_depth
    for sequence in ("chess/seq-01", "chess/seq-02", "fire/seq-01"):
        touch(tmp_path / "7" / sequence / "frame-000000.color.png")
        touch(tmp_path / "7" / sequence / "frame-000000.pose.txt")
    touch(tmp_path / "7" / "chess" / "seq-02" / "frame-000020.depth.png")
    surface = touch(tmp_path / "7" / "fire" / "tsdf_pseudo_gt.ply")
    names = [s.name for s in find_seven_scenes(tmp_path / "7")]
    assert names == ["chess-seq-01", "chess-seq-02", "fire-seq-01"]
    assert [s.has_depth for s in find_seven_scenes(tmp_path / "7")] == [False, True, False]
    assert find_seven_scenes(tmp_path / "7" / "fire")[0].truth.surface == surface


def test_dtu_with_and_without_the_official_files(tmp_path):
    for name in ("scan40", "scan105"):
        write_dtu(flat_room(), tmp_path / name)
    plain = find_dtu(tmp_path)
    assert [s.name for s in plain] == ["scan40", "scan105"]
    assert plain[0].truth.dtu is None
    assert Option("hold-out", "8") in plain[0].options
    official = tmp_path / "SampleSet" / "MVS Data"
    touch(official / "ObsMask" / "ObsMask40_10.mat")
    (official / "Points" / "stl").mkdir(parents=True)
    first, second = find_dtu(tmp_path)
    assert (first.truth.dtu.folder, first.truth.dtu.scan) == (official, 40)
    assert Option("hold-out", "8") not in first.options
    assert Option("input.long-edge", "800") in first.options
    assert second.truth.dtu is None


def test_every_benchmark_says_what_it_needs_and_a_wrong_name_gets_a_hint():
    for name, benchmark in BENCHMARKS.items():
        assert benchmark.name == name
        assert benchmark.needs
        assert benchmark.source
        assert benchmark.layouts
    with pytest.raises(InputError, match="did you mean replica"):
        find_benchmark("replicas")


def test_the_development_rooms_are_found(shared_data):
    names = [scene.name for scene in find_rooms(shared_data / "rooms")]
    assert names == ["living-room-2", "living-room-2-light", "staircase"]
    assert [s.name for s in find_objects(shared_data)] == ["horse"]
    (scan,) = find_dtu(shared_data / "dtu")
    assert scan.name == "scan24"
    folder = shared_data / "7scenes-redkitchen"
    (kitchen,) = find_seven_scenes(folder)
    assert kitchen.truth.surface == folder.resolve() / "tsdf_pseudo_gt.ply"
