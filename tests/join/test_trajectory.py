"""Frames of parts in the joint world and time."""

import numpy as np
import pytest
import torch

from geogs.geometry.lie import se3_exp, sim3_exp, sim3_scale
from geogs.types import Trajectory
from geogs.world.loops import ImageFeatures
from geogs_fleet.join.joined_files import joined_trajectory, moved_trajectory, spans_of
from geogs_fleet.join.part import PartViews
from geogs_fleet.join.part_graph import Placement

NONE = ImageFeatures(np.zeros((0, 2), np.float32), np.zeros((0, 32), np.uint8))


def walk(n: int) -> torch.Tensor:
    """Camera to world."""
    steps = 0.1 * torch.randn(n, 6, generator=torch.Generator().manual_seed(7)).double()
    return torch.linalg.inv(torch.stack([se3_exp(s) for s in steps.cumsum(0)]))


def views_of(T_wc: torch.Tensor, times: np.ndarray) -> PartViews:
    ones = np.ones((len(T_wc), 4), np.float32)
    return PartViews(torch.linalg.inv(T_wc).numpy(), times, ones, ones, (NONE,) * len(T_wc))


def placement(T_wc: torch.Tensor, S: torch.Tensor) -> Placement:
    """Keyframes moved by similarities of the world."""
    moved = S @ T_wc
    moved[:, :3, :3] /= sim3_scale(S)[:, None, None]
    return Placement(torch.linalg.inv(moved), 1 / sim3_scale(S))


def test_all_frames_go_where_one_similarity_takes_them():
    T_wc, times = walk(9), np.arange(9) / 3.0
    S = sim3_exp(torch.tensor([0.5, -1.0, 0.2, 0.3, -0.2, 0.1, 0.4]).double())
    key = slice(1, 9, 3)
    placed = placement(T_wc[key], S.expand(3, 4, 4))
    given = Trajectory(times, T_wc.numpy(), np.ones(9, bool))
    moved = moved_trajectory(given, views_of(T_wc[key], times[key]), placed)
    for k in range(9):
        assert moved.T_wc[k, :3, 3] == pytest.approx((S @ T_wc[k])[:3, 3].numpy(), abs=1e-9)
        R = (S[:3, :3] / sim3_scale(S) @ T_wc[k, :3, :3]).numpy()
        assert moved.T_wc[k, :3, :3] == pytest.approx(R, abs=1e-9)


def test_between_keyframes_that_moved_apart_a_frame_follows_both_by_its_time():
    T_wc, times = torch.eye(4).double().repeat(5, 1, 1), np.arange(5.0)
    S = torch.eye(4).double().repeat(2, 1, 1)
    S[1, 0, 3] = 4.0
    placed = placement(T_wc[[0, 4]], S)
    given = Trajectory(times, T_wc.numpy(), np.ones(5, bool))
    moved = moved_trajectory(given, views_of(T_wc[[0, 4]], times[[0, 4]]), placed)
    assert moved.T_wc[:, 0, 3] == pytest.approx([0, 1, 2, 3, 4])


def test_a_part_with_one_keyframe_and_frames_before_it():
    T_wc = walk(3)
    placed = placement(T_wc[1:2], torch.eye(4).double()[None])
    given = Trajectory(np.arange(3.0), T_wc.numpy(), np.ones(3, bool))
    moved = moved_trajectory(given, views_of(T_wc[1:2], np.array([1.0])), placed)
    assert moved.T_wc == pytest.approx(T_wc.numpy())


def test_times_follow_each_other_whatever_they_were():
    times = [np.array([5.0, 6.0]), np.array([5.0, 7.5]), np.array([0.0, 0.5])]
    spans = spans_of(["a", "b", "c"], times)
    assert [(s.first_frame, s.first_time, s.own_time) for s in spans] == [
        (0, 5.0, 5.0), (2, 7.0, 5.0), (4, 10.5, 0.0),
    ]  # fmt: skip
    parts = [Trajectory(t, np.tile(np.eye(4), (2, 1, 1)), np.ones(2, bool)) for t in times]
    joint = joined_trajectory(parts, spans)
    assert joint.timestamps.tolist() == [5.0, 6.0, 7.0, 9.5, 10.5, 11.0]
