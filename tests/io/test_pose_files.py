"""Reading trajectories: formats, invalid rows, wrong orders."""

import logging

import numpy as np
import pytest
import torch

from geogs.errors import InputError
from geogs.geometry.lie import se3_exp
from geogs.io.pose_files import (
    read_frame_poses,
    read_poses,
    read_replica_trajectory,
    read_seven_scenes_poses,
    read_tum_trajectory,
)
from geogs.io.writers.trajectories import write_trajectories
from geogs.types import Trajectory

IDENTITY_ROW = "0 0 0 0 0 0 0 1"


def random_poses(count: int) -> np.ndarray:
    generator = torch.Generator().manual_seed(3)
    return se3_exp(torch.randn(count, 6, generator=generator, dtype=torch.float64)).numpy()


def test_tum_quaternion_is_x_y_z_w(tmp_path):
    half = np.sqrt(0.5)
    file = tmp_path / "gt.txt"
    file.write_text(f"# comment\n2.5 1 2 3 0 0 {half} {half}\n{IDENTITY_ROW}\n")
    trajectory = read_tum_trajectory(file)
    assert trajectory.timestamps.tolist() == [0.0, 2.5]  # sorted by time
    quarter_turn_about_z = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    np.testing.assert_allclose(trajectory.T_wc[1, :3, :3], quarter_turn_about_z, atol=1e-15)
    assert trajectory.T_wc[1, :3, 3].tolist() == [1, 2, 3]
    assert trajectory.tracked.all()


def test_tum_accepts_commas_and_slightly_unnormalised_quaternions(tmp_path):
    file = tmp_path / "gt.txt"
    file.write_text("0,0,0,0,0,0,0,1.01\n")
    np.testing.assert_allclose(read_tum_trajectory(file).T_wc[0], np.eye(4), atol=1e-15)


def test_rows_without_a_pose_are_dropped_and_counted(tmp_path, caplog):
    file = tmp_path / "gt.txt"
    bad = ["1 nan 0 0 0 0 0 1", "2 0 0 0 0 0 0 0", "3 inf 0 0 0 0 0 1"]
    file.write_text("\n".join([IDENTITY_ROW, *bad, "4 0 0 1 0 0 0 1"]))
    with caplog.at_level(logging.WARNING, logger="geogs"):
        trajectory = read_tum_trajectory(file)
    assert trajectory.timestamps.tolist() == [0, 4]
    assert "dropped 3 of 5 poses" in caplog.text


def test_w_first_is_refused(tmp_path):
    file = tmp_path / "gt.txt"
    file.write_text("0 0 0 0 1 0 0 0\n1 0 0 0 0.9998 0.02 0 0\n")
    with pytest.raises(InputError, match="w x y z order"):
        read_tum_trajectory(file)


def test_quaternion_before_translation_is_detected_by_its_norm(tmp_path):
    file = tmp_path / "gt.txt"
    file.write_text("".join(f"{t} 1 0 0 0 {t} 2 3\n" for t in range(1, 5)))
    with pytest.raises(InputError, match="no unit quaternions"):
        read_tum_trajectory(file)


def test_matrix_rows_of_16_and_12_numbers(tmp_path):
    poses = random_poses(5)
    np.savetxt(tmp_path / "replica.txt", poses.reshape(5, 16))
    np.savetxt(tmp_path / "kitti.txt", poses[:, :3].reshape(5, 12))
    np.testing.assert_allclose(
        read_replica_trajectory(tmp_path / "replica.txt").T_wc, poses, atol=1e-15
    )
    np.testing.assert_allclose(
        read_replica_trajectory(tmp_path / "kitti.txt").T_wc, poses, atol=1e-15
    )


def test_dropped_matrix_rows_keep_the_times_of_the_others(tmp_path):
    poses = random_poses(6)
    poses[1], poses[3, 0, 3], poses[4] = 0, np.nan, np.inf
    np.savetxt(tmp_path / "traj.txt", poses.reshape(6, 16))
    trajectory = read_replica_trajectory(tmp_path / "traj.txt")
    np.testing.assert_allclose(trajectory.timestamps * 30, [0, 2, 5])
    np.testing.assert_allclose(trajectory.T_wc, poses[[0, 2, 5]], atol=1e-15)


def test_matrices_that_are_no_rotations_are_refused(tmp_path):
    poses = random_poses(4)
    np.savetxt(tmp_path / "transposed.txt", poses.transpose(0, 2, 1)[:, ::-1].reshape(4, 16))
    with pytest.raises(InputError, match="no rigid motions"):
        read_replica_trajectory(tmp_path / "transposed.txt")


def test_seven_scenes_poses_carry_their_frame_numbers(tmp_path):
    poses = random_poses(3)
    for number, pose in zip((0, 20, 7), poses, strict=True):
        np.savetxt(tmp_path / f"frame-{number:06d}.pose.txt", pose)
    np.savetxt(tmp_path / "frame-000008.pose.txt", np.full((4, 4), -np.inf))
    trajectory = read_seven_scenes_poses(tmp_path)
    np.testing.assert_allclose(trajectory.timestamps * 30, [0, 7, 20])
    np.testing.assert_allclose(trajectory.T_wc, poses[[0, 2, 1]], atol=1e-15)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "no poses"),
        ("# nothing\n", "no poses"),
        ("0 0 0 0 0 0 0 1\n1 0 0", "line 2: expected"),
        ("0 0 0 zero 0 0 0 1\n", "line 1: not a row of numbers"),
        ("0 nan 0 0 0 0 0 1\n", "no valid pose"),
    ],
)
def test_unusable_pose_files(tmp_path, content, message):
    file = tmp_path / "gt.txt"
    file.write_text(content)
    with pytest.raises(InputError, match=message):
        read_tum_trajectory(file)


def test_missing_and_binary_pose_files(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        read_poses(tmp_path / "nothing.txt")
    (tmp_path / "binary.txt").write_bytes(b"\xff\xfe\x00\x81" * 10)
    with pytest.raises(InputError, match="not a text file"):
        read_poses(tmp_path / "binary.txt")
    with pytest.raises(InputError, match="no frame-"):
        read_seven_scenes_poses(tmp_path)


def test_shared_sequences(shared_data):
    counts = {
        "rooms/living-room-2": 400,
        "replica/room0-first10": 10,
        "7scenes-redkitchen/seq-01": 500,
    }
    for name, count in counts.items():
        assert len(read_poses(shared_data / name).timestamps) == count


def test_frames_that_only_turned_are_read_with_the_others_or_alone(tmp_path):
    T_wc = np.tile(np.eye(4), (3, 1, 1))
    T_wc[:, 0, 3] = [1.0, 2.0, 3.0]
    seen = Trajectory(np.arange(3.0), T_wc, np.array([1, 0, 0], bool), np.array([0, 1, 0], bool))
    write_trajectories(tmp_path, seen, seen)
    found = read_frame_poses(tmp_path)
    assert found.states == ["tracked", "orientation only"]
    assert found.timestamps.tolist() == [0.0, 1.0]
    assert found.T_wc[:, 0, 3].tolist() == [1.0, 0.0]
    turned = Trajectory(np.arange(3.0), T_wc, np.zeros(3, bool), np.ones(3, bool))
    write_trajectories(tmp_path, turned, turned)
    assert read_frame_poses(tmp_path).states == 3 * ["orientation only"]
    lost = Trajectory(np.arange(3.0), T_wc, np.zeros(3, bool))
    (tmp_path / "lost").mkdir()
    write_trajectories(tmp_path / "lost", lost, lost)
    assert not (tmp_path / "lost" / "orientations.tum").exists()
    with pytest.raises(InputError):
        read_frame_poses(tmp_path / "lost")
