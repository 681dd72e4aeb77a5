"""Reconstruction from known poses: through the command line, and its parts."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from called_commands import done
from depth_scene import WORKING, make_scene, trace
from geogs.application.result_settings import RemeshSettings
from geogs.application.results.revise import mesh_settings, remesh
from geogs.cli import main as cli
from geogs.config import InputConfig
from geogs.depth.classical import CpuDepthEngine
from geogs.depth.depth_engine import DepthTask
from geogs.depth.depth_view import ViewPose
from geogs.depth.estimate import estimate_depth
from geogs.errors import InputError
from geogs.io.pose_files import read_tum_trajectory
from geogs.io.sources.sniff import open_posed_source
from geogs.io.writers.map_file import load_map
from geogs.mapping.first_look import distances_to_try
from geogs.mapping.known_poses import depth_search
from geogs.mapping.map_all import spread_order
from geogs.mesh.mesh_file import read_mesh
from geogs.reconstruction import Reconstruction
from posed_scene import DEFAULT, SMALL, ball_and_wall, depth_errors, geogs, surface_points, vertices

pytestmark = pytest.mark.system

QUICK = ["--mapping.render-long-edge", "160", "--search.least-steps", "150", "--device", "cpu"]


@pytest.fixture(scope="session")
def result(room, once) -> Path:
    """What ``geogs reconstruct`` makes of every fifth frame."""

    def run(folder: Path) -> None:
        done = geogs("reconstruct", room, "-o", folder, "--stride", 5, *QUICK)
        assert done.returncode == 0, done.stderr

    return once("reconstruction", run)


USED = [0, 5, 15, 20, 25, 35, 40, 45, 55]
"""Every fifth frame but every fourth of these."""


@pytest.fixture(scope="session")
def small_result(small_room, once) -> Path:
    """What it makes of smaller images, with all that can be asked for."""

    def run(folder: Path) -> None:
        said = done(
            "reconstruct", small_room, "-o", folder, "--stride", 5, "--hold-out", 4,
            "--snapshots", "0.01,5s,0.2m,1h", "--depth-mesh", "--search.no-repeat",
            "--search.least-steps", 100, "--mapping.render-long-edge", 96, "--device", "cpu",
        )  # fmt: skip
        assert "No snapshot after 0.01 s" in said

    return once("small-reconstruction", run)


@pytest.mark.long
def test_the_mesh_lies_on_the_room_in_metres_without_alignment(room, result):
    seen, mesh = vertices(room / "points_seen_1cm.ply"), surface_points(result / "mesh.ply", 40_000)
    accuracy = 100 * cKDTree(seen).query(mesh[::7])[0]
    completeness = 100 * cKDTree(mesh).query(seen[::7])[0]
    print(f"accuracy {accuracy.mean():.2f} cm, median {np.median(accuracy):.2f}")
    print(f"within 5 cm: {(accuracy < 5).mean():.3f}, of the room {(completeness < 5).mean():.3f}")
    assert np.median(accuracy) < 1.0
    assert accuracy.mean() < 2.5
    assert (completeness < 5).mean() > 0.7


def test_it_leaves_every_file_and_the_given_poses(small_room, small_result):
    names = [
        "trajectory.tum", "keyframes.tum", "intrinsics.json", "mesh.ply", "splats.ply",
        "map.safetensors", "config.yaml", "summary.json", "report/keyframes.png",
    ]  # fmt: skip
    assert [n for n in names if not (small_result / n).is_file()] == []
    given = np.loadtxt(small_room / "traj.txt").reshape(-1, 4, 4)[USED]
    trajectory = read_tum_trajectory(small_result / "trajectory.tum")
    assert np.abs(trajectory.T_wc - given).max() < 1e-5
    summary = json.loads((small_result / "summary.json").read_text())
    assert summary["held_out"] == [10, 30, 50]
    assert summary["frames"] == summary["keyframes"] == len(USED)
    assert summary["scale"] == "of the poses (metres)"
    assert summary["interrupted"] is False
    assert set(summary["frames_per_second"]) == {"with_final_stages"}
    assert summary["disks"] == len(load_map(small_result / "map.safetensors")) > 1000
    seconds = summary["seconds"]
    assert seconds["total"] == pytest.approx(sum(seconds.values()) - seconds["total"], abs=0.1)


def test_earlier_maps_and_the_depths_alone_are_written(small_room, small_result):
    names = sorted(p.name for p in (small_result / "snapshots").glob("*"))
    assert set(names) <= {"5", "12"}
    folders = [small_result, small_result / "depth_fusion"]
    folders += (small_result / "snapshots").glob("*")
    seen = vertices(small_room / "points_seen_1cm.ply")
    for folder in folders:
        accuracy = cKDTree(seen).query(surface_points(folder / "mesh.ply"))[0]
        assert np.median(accuracy) < 0.03
    for name in names:
        assert len(load_map(small_result / "snapshots" / name / "map.safetensors")) > 500


@pytest.mark.long
def test_an_earlier_snapshot_can_be_rendered():
    scene, kept = ball_and_wall(far=1e3), []

    def keep(name: str, fraction: float) -> None:
        if name == "growing":
            kept.append(scene.snapshot())

    assert scene.elapsed == 0
    scene.finish(progress=keep)
    assert scene.elapsed > 0
    now, same = scene.renders(), scene.renders(scene.snapshot())
    earlier = scene.renders(kept[0])
    for a, b, c in zip(now, same, earlier, strict=True):
        shown = (a.depth > 0) & (b.depth > 0)
        assert ((a.depth - b.depth).abs()[shown] / a.depth[shown]).quantile(0.95) < 2e-3
        assert not torch.equal(a.depth, c.depth)
        assert torch.equal(a.T_cw, c.T_cw)


def test_the_mesh_is_made_again_from_the_folder_as_it_was(small_result, tmp_path):
    mesh = mesh_settings(small_result)
    path = remesh(RemeshSettings(small_result, mesh, tmp_path / "m.ply", "cpu"))
    made, again = read_mesh(small_result / "mesh.ply"), read_mesh(path)
    for name in ("vertices", "faces", "normals"):
        np.testing.assert_array_equal(getattr(made, name), getattr(again, name))
    assert np.abs(made.colours.astype(int) - again.colours).mean() < 1.0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--hold-out", 1], "at least 2"),
        (["--hold-out", 0], "at least 2"),
        (["--stop", 2, "--hold-out", 2], "Of 2 images only 1"),
        (["--snapshots", "5,soon"], "soon"),
    ],
)
def test_options_that_leave_nothing_to_do(small_room, tmp_path, options, words, capsys):
    argv = ["reconstruct", small_room, "-o", tmp_path / "out", *options]
    assert cli.main([str(a) for a in argv]) == 2
    said = capsys.readouterr().err
    assert words in said.splitlines()[-1]
    assert "Traceback" not in said


def test_held_out_images_are_named_by_their_place_in_the_whole_source(small_room):
    config = InputConfig(start=10, stop=30, stride=3)
    source = open_posed_source(small_room, config, 3)
    assert source.held_out == [13, 22]
    assert [source.label(i)[-8:-4] for i in range(len(source))] == [
        "0010", "0016", "0019", "0025", "0028"
    ]  # fmt: skip


def test_wrong_input_is_one_sentence(small_room, tmp_path, capsys):
    missing = [tmp_path / "none"]
    one = [small_room, "--stop", 1, "-o", tmp_path / "a", *QUICK]
    budget = [small_room, "--budget", "soon"]
    for call, words in ((missing, "does not exist"), (one, "at least two"), (budget, "90s")):
        assert cli.main(["reconstruct", *map(str, call)]) == 2
        said = capsys.readouterr().err
        assert words in said.splitlines()[-1]
        assert "Traceback" not in said


def test_a_full_gpu_memory_is_one_sentence(small_room, tmp_path, monkeypatch, capsys):
    def full(*_: object) -> None:
        raise torch.cuda.OutOfMemoryError("CUDA out of memory.")

    monkeypatch.setattr(Reconstruction, "finish", full)
    assert cli.main(["reconstruct", str(small_room), "-o", str(tmp_path), *QUICK]) == 2
    said = capsys.readouterr().err
    assert "The memory of the GPU is full; use fewer images" in said
    assert "Traceback" not in said


def test_poses_in_another_convention_are_noticed(small_room, tmp_path, capsys):
    """World to camera where camera to world is expected."""
    turned = tmp_path / "room"
    shutil.copytree(small_room, turned)
    poses = np.loadtxt(turned / "traj.txt").reshape(-1, 4, 4)
    np.savetxt(turned / "traj.txt", np.linalg.inv(poses).reshape(-1, 16))
    assert cli.main(["reconstruct", str(turned), "-o", str(tmp_path / "out"), *QUICK]) == 2
    said = capsys.readouterr().err
    assert "world" in said.splitlines()[-1]
    assert "Traceback" not in said


@pytest.mark.parametrize("scale", [1000.0, pytest.param(0.001, marks=pytest.mark.long)])
def test_depth_is_right_in_any_unit(scale):
    far = 1e5 * scale
    scene = ball_and_wall(scale, far=far)
    scene.finish()
    errors = depth_errors(scene, scale)
    print(f"scale {scale}: median {np.median(errors):.5f}, 90 % {np.quantile(errors, 0.9):.4f}")
    assert np.median(errors) < 0.004
    assert np.quantile(errors, 0.9) < 0.04
    assert len(errors) > 0.9 * 5 * 96 * 72
    assert (scene.snapshot().position - far).abs().max() < 10 * scale
    assert 1e-4 * scale < scene.snapshot().scale.median() < 0.1 * scale
    for view, found in zip(make_scene().views, scene.depth_maps(), strict=True):  # as searched
        truth = trace(scene.mapper.cameras.render, np.linalg.inv(view.T_cw))[0] * scale
        confident = found.weight.numpy() > 0.5
        assert confident.mean() > 0.1
        assert np.median(np.abs(found.depth.numpy() / truth - 1)[confident]) < 0.005
        assert ((found.normal * found.camera.rays()).sum(-1) <= 1e-6).all()


@pytest.mark.long
def test_given_points_replace_the_first_look():
    scene = ball_and_wall()
    points = np.concatenate([
        trace(WORKING, np.linalg.inv(v.T_cw))[1][::12, ::12].reshape(-1, 3)
        for v in make_scene().views
    ])  # fmt: skip
    scene.finish(points)
    assert "first look" not in scene.stopwatch.seconds
    assert np.median(depth_errors(scene)) < 0.004


def test_only_the_inside_of_masks_is_reconstructed():
    scene = Reconstruction(WORKING, SMALL)
    masks = []
    for view in make_scene().views:
        points = trace(WORKING, np.linalg.inv(view.T_cw))[1]
        masks.append(np.linalg.norm(points - [0.1, 0.05, 2.0], axis=-1) < 0.401)
        scene.add(view.image, view.T_cw, masks[-1])
    scene.finish()
    size = (scene.mapper.cameras.render.width, scene.mapper.cameras.render.height)
    for render, mask in zip(scene.renders(), masks, strict=True):
        small = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5
        assert not (render.depth.numpy()[~small] > 0).any()
        assert not (render.weight.numpy()[~small] > 0).any()
        assert (render.depth.numpy()[small] > 0).mean() > 0.9
    assert np.median(depth_errors(scene)) < 0.008  # steep, and small in the images
    radius = (scene.snapshot().position - torch.tensor([0.1, 0.05, 2.0])).norm(dim=1)
    assert float(((radius - 0.4).abs() < 0.04).float().mean()) > 0.9


@pytest.mark.parametrize("stage", ["depth", "training"])
def test_an_interruption_keeps_what_there_is(stage):
    def interrupt(name: str, fraction: float) -> None:
        if name == stage:
            raise KeyboardInterrupt

    scene = ball_and_wall()
    with pytest.raises(KeyboardInterrupt):
        scene.finish(progress=interrupt)
    assert len(scene.snapshot()) > 500
    assert np.median(depth_errors(scene)) < 0.01


def test_poses_that_show_nothing_are_refused():
    noise, still = Reconstruction(WORKING, SMALL), Reconstruction(WORKING, SMALL)
    rng = np.random.default_rng(0)
    for view in make_scene().views:
        noise.add(rng.integers(0, 255, view.image.shape, dtype=np.uint8), view.T_cw)
        still.add(view.image, make_scene().views[0].T_cw)
    for scene in (noise, still):
        with pytest.raises(InputError, match="same surface"):
            scene.finish()
        assert len(scene.snapshot()) == 0


def test_where_depth_is_searched_follows_from_the_points():
    view = ViewPose(0, np.eye(4))
    z = np.linspace(2.0, 4.0, 401)
    seen = np.stack([0 * z, 0 * z, z], 1)
    beside, behind = seen + np.array([50.0, 0, 0]), -10 * seen
    found = depth_search(view, np.concatenate([seen, beside, behind]), WORKING, 1.3)
    assert found.near == pytest.approx(2.01 / 1.3, rel=1e-3)
    assert found.typical == pytest.approx(3.0, rel=1e-3)
    assert found.far == pytest.approx(3.99 * 1.3, rel=1e-3)
    assert depth_search(view, beside, WORKING, 1.0).typical == pytest.approx(3.0, rel=1e-3)


def test_the_tried_distances_hold_the_right_one_and_scale_with_the_poses():
    views = make_scene().views
    tried = distances_to_try(views)
    assert tried[0] < 2.0 < tried[-1]
    assert len(tried) < 12
    bigger = [replace(v, T_cw=v.T_cw * np.array([1, 1, 1, 7.0])) for v in views]
    assert np.allclose(distances_to_try(bigger), 7 * tried)
    assert len(distances_to_try([views[0]] * 3)) == 0


def test_an_engine_searches_between_given_limits():
    scene = make_scene()
    views, cameras = scene.views[:3], (WORKING.resized(96, 72), WORKING)
    engine = CpuDepthEngine(*cameras, DEFAULT.mapping.depth.planes)
    (depth,) = engine.estimate([DepthTask(views[0], views[1:], (2.6, 5.0))])
    expected = estimate_depth(views[0], views[1:], *cameras, (2.6, 5.0))
    assert (depth.depth.numpy() == expected.depth).all()
    (free,) = engine.estimate([DepthTask(views[0], views[1:])])
    assert not (depth.depth == free.depth).all()


def test_depths_are_searched_for_as_many_images_as_time_allows():
    assert spread_order([3, 4, 5, 6, 7]) == [3, 7, 5, 4, 6]
    assert sorted(spread_order(range(49))) == list(range(49))
    fewer = spread_order(range(48))[:12]
    assert max(np.diff(sorted(fewer))) <= 5
    slow = replace(SMALL, search=replace(SMALL.search, depth_ratio=0.001))
    scene = Reconstruction(WORKING, slow, budget=6.0)
    for view in make_scene().views:
        scene.add(view.image, view.T_cw)
    scene.finish()
    assert scene.frames == 5
    assert scene.with_depth == 4
    assert [r.keyframe_id for r in scene.renders()] == [0, 1, 2, 4]
    assert len(scene.snapshot()) > 500
