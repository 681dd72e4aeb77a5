"""The system as Python programs use it."""

import json
import re
import threading
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

import geogs
from geogs.cli.main import main
from geogs.config import Config, InputConfig
from geogs.errors import InputError
from geogs.evaluation.trajectory_errors import evaluate_trajectory
from geogs.geometry.umeyama import umeyama
from geogs.io.pose_files import read_tum_trajectory
from geogs.types import Trajectory
from geogs.world.segments import TrackState
from quick_systems import quick_config

FIRST, SECOND, END = 28, 24, 42
"""Frames where the first video ends, and where the second begins and ends."""
CAMERA = geogs.Camera(fx=90.0, fy=90.0, cx=63.5, cy=47.5, width=128, height=96)


def config() -> Config:
    return quick_config(pose_iterations=0, final_iterations=10)


@pytest.fixture(scope="module")
def first(small_room, tmp_path_factory):
    """A finished system of the first half of a small room, its poses at once, and where it is."""
    source = geogs.open_source(small_room, InputConfig(stop=FIRST))
    slam = geogs.Slam(source.camera, config(), device="cpu")
    poses = list(geogs.track(source, slam=slam))
    slam.finish()
    return slam, poses, geogs.save_slam(slam, tmp_path_factory.mktemp("saved"))


@pytest.mark.system
def test_poses_at_once_are_near_those_of_the_end(first):
    slam, poses, _ = first
    assert [p.frames for p in poses] == [*range(1, FIRST + 1)]
    assert poses[0].state is TrackState.INITIALIZING
    assert not poses[0].is_tracked
    assert poses[-1].is_tracked
    trajectory = slam.trajectory()
    extent = np.ptp(trajectory.T_wc[:, :3, 3], axis=0).max()
    last = np.linalg.norm(poses[-1].T_wc[:3, 3] - trajectory.T_wc[-1, :3, 3])
    assert last < 0.2 * extent
    assert 0 < poses[-1].sigma_position < 0.2 * extent
    assert 0 < poses[-1].sigma_rotation < 0.05
    assert slam.pose is poses[-1]


@pytest.mark.system
def test_the_map_is_asked_and_kept(first):
    slam, _, folder = first
    assert len(geogs.slam_mesh(slam).faces) > 100
    maps = slam.render(slam.trajectory().T_wc[5])
    assert maps.depth.shape == (48, 64)
    assert maps.normal.shape == (48, 64, 3)
    assert isinstance(maps.depth, np.ndarray)
    with pytest.raises(InputError, match="4x4"):
        slam.render(np.full((4, 4), np.nan))
    again = geogs.load_result(folder)
    T_cw = np.linalg.inv(slam.trajectory().T_wc[5])
    for pose in (T_cw, torch.from_numpy(T_cw)):
        np.testing.assert_array_equal(again.render(pose).depth, slam.render(T_cw).depth)
    assert len(again.disks) == len(slam.snapshot())
    assert len(again.keyframes) == len(slam.segments.keyframe_ids)
    assert len(read_tum_trajectory(folder / "trajectory.tum").timestamps) == FIRST


@pytest.mark.system
def test_another_video_is_found_in_a_saved_map(first, small_room):
    _, _, folder = first
    slam = geogs.load_slam(folder, config(), device="cpu")
    held = {i: slam.world.keyframes[i].T_cw for i in slam.segments.main.segment.fixed}
    before = len(slam.snapshot())
    source = geogs.open_source(small_room, InputConfig(start=SECOND, stop=END))
    poses = list(geogs.track(source, slam=slam))
    assert poses[0].is_tracked
    slam.finish()
    trajectory = slam.trajectory()
    assert trajectory.tracked.mean() >= 0.95
    truth = np.loadtxt(small_room / "traj.txt").reshape(-1, 4, 4)
    former = read_tum_trajectory(folder / "trajectory.tum")
    # By the alignment of the first video: the world is that of its map.
    scale, R, t = umeyama(*map(torch.from_numpy, (former.T_wc[:, :3, 3], truth[:FIRST, :3, 3])))
    places = torch.from_numpy(trajectory.T_wc[trajectory.tracked][:, :3, 3])
    there = truth[SECOND:END][trajectory.tracked][:, :3, 3]
    error = (scale * places @ R.T + t).numpy() - there
    assert 100 * np.sqrt(np.square(error).sum(1).mean()) < 3  # cm; 0.5 where this was written
    assert all(torch.equal(slam.world.keyframes[i].T_cw, T) for i, T in held.items())
    assert len(slam.snapshot()) > 0.7 * before
    assert len(slam.uncertainty().position) == trajectory.tracked.sum() > 0


@pytest.mark.system
def test_photographs_are_located_in_a_saved_map(first, small_room, tmp_path, capsys):
    _, _, folder = first
    truth = np.loadtxt(small_room / "traj.txt").reshape(-1, 4, 4)
    former = read_tum_trajectory(folder / "trajectory.tum")
    scale, R, t = umeyama(*map(torch.from_numpy, (former.T_wc[:, :3, 3], truth[:FIRST, :3, 3])))
    for number in (4, FIRST - 2):
        photo = next(small_room.glob(f"**/frame{number:06d}.*"))
        arguments = ["locate", str(photo), "--map", str(folder), "-o", str(tmp_path)]
        assert main([*arguments, "--device", "cpu"]) == 0
        said = capsys.readouterr().out
        assert "Near keyframe" in said
        row = [float(n) for n in re.search(r"qw: (.*)", said)[1].split()]
        at = (scale * R @ torch.tensor(row[:3], dtype=torch.float64) + t).numpy()
        assert 100 * np.linalg.norm(at - truth[number, :3, 3]) < 3
        document = json.loads((tmp_path / f"{photo.stem}.json").read_text())
        np.testing.assert_allclose(np.array(document["T_wc"])[:3, 3], row[:3], rtol=1e-4)
        assert 0 < document["sigma_position"] < 0.1
        assert document["nearest"][0]["distance"] < 0.2
        assert cv2.imread(str(tmp_path / f"{photo.stem}.png")).shape[1] > 1200
    noise = np.random.default_rng(0).integers(0, 255, (96, 128, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "noise.png"), noise)
    arguments = ["locate", str(tmp_path / "noise.png"), "--map", str(folder), "--device", "cpu"]
    assert main(arguments) == 2
    assert "was not found" in capsys.readouterr().err
    assert not (folder / "located").exists()


@pytest.mark.system
def test_what_shows_another_place_is_not_found(first):
    _, _, folder = first
    slam = geogs.load_slam(folder, config(), device="cpu")
    noise = np.random.default_rng(0).integers(0, 255, (4, 96, 128, 3), np.uint8)
    assert not any(slam.process(image).is_tracked for image in noise)
    slam.finish()
    assert not slam.trajectory().tracked.any()
    assert slam.uncertainty().position.size == 0


@pytest.mark.system
def test_mapping_beside_tracking_comes_to_the_same_where_nothing_is_late(small_room):
    source = geogs.open_source(small_room, InputConfig(stop=18))
    without_loops = replace(config(), loop=replace(config().loop, enabled=False))
    maps = []
    for live in (False, True):
        slam = geogs.Slam(source.camera, without_loops, live=live, device="cpu")
        for frame in source:
            pose = slam.process(frame)
            slam.settle()
        if live:
            assert slam.render(pose.T_cw).depth.shape == (48, 64)  # asked of the thread
        slam.finish()
        maps.append(slam.snapshot())
    assert len(maps[0]) > 100
    assert torch.equal(maps[0].position, maps[1].position)


@pytest.mark.system
def test_a_frame_does_not_wait_for_a_keyframe_that_is_being_completed(small_room):
    source = geogs.open_source(small_room, InputConfig(stop=SECOND))
    slam = geogs.Slam(source.camera, config(), live=True, device="cpu")
    go_on, complete, beside = threading.Event(), slam.segments.complete, 0

    def complete_when_told() -> object:
        assert go_on.wait(60)
        return complete()

    slam.segments.complete = complete_when_told
    for frame in source:
        pose = slam.process(frame)
        if pose.is_tracked and beside:
            assert 0 < pose.sigma_position < 0.1
        beside += slam.executor.is_completing
        if beside == 2:  # the frame of a keyframe, and the one after it
            before = pose.T_cw
            go_on.set()
            slam.settle()
            np.testing.assert_allclose(slam.T_cw, before, rtol=0, atol=0.02)
    assert beside >= 2
    slam.finish()
    trajectory = slam.trajectory()
    assert trajectory.tracked.all()
    truth = np.loadtxt(small_room / "traj.txt").reshape(-1, 4, 4)[:SECOND]
    reference = Trajectory(trajectory.timestamps, truth, np.ones(SECOND, dtype=bool))
    assert evaluate_trajectory(trajectory, reference).ate_rmse_cm < 0.6


def test_images_that_cannot_be_used_end_in_a_sentence():
    slam = geogs.Slam(CAMERA, config(), device="cpu")
    good = np.zeros((96, 128, 3), np.uint8)
    wrong = {
        "grey": np.zeros((96, 128), np.uint8),
        "float64; give uint8": np.zeros((96, 128, 3)),
        "array of 96x128x4": np.zeros((96, 128, 4), np.uint8),
        "64 x 48 pixels, the camera 128 x 96": np.zeros((48, 64, 3), np.uint8),
    }
    for sentence, image in wrong.items():
        with pytest.raises(InputError, match=sentence):
            slam.process(image)
    assert slam.frames == 0
    assert slam.process(good, 2.0).timestamp == 2.0
    with pytest.raises(InputError, match="times have to increase"):
        slam.process(good, 2.0)
    assert slam.process(good).timestamp == pytest.approx(2.0 + 1 / 30)
    assert slam.process(torch.from_numpy(good)).frames == 3
    assert geogs.slam_mesh(slam) is None
    with pytest.raises(InputError, match="no map to render yet"):
        slam.render(np.eye(4))
    with pytest.raises(InputError, match="no map to save"):
        geogs.save_slam(slam, "nowhere")


def test_there_has_to_be_a_map_to_load(tmp_path):
    with pytest.raises(InputError, match="holds no result"):
        geogs.load_slam(tmp_path)


@pytest.mark.gpu
@pytest.mark.system
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_live_system_on_a_gpu_tracks_and_maps(small_room, tmp_path):
    source = geogs.open_source(small_room, InputConfig(stop=FIRST))
    slam = geogs.Slam(source.camera, config(), device="cuda", live=True)
    poses = list(geogs.track(source, slam=slam))
    assert poses[-1].is_tracked
    assert poses[-1].sigma_position < np.inf
    slam.finish()
    assert slam.trajectory().tracked.mean() > 0.9
    assert len(slam.snapshot()) > 100
    again = geogs.load_slam(geogs.save_slam(slam, tmp_path), config(), device="cuda", live=True)
    assert next(geogs.track(source, slam=again)).is_tracked
    again.finish()
