"""Two ways to place the same frames: do they turn the camera alike?"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geogs.application.structure_from_motion.agreement import has_wrong_joint, rotations_agree
from geogs.types import Trajectory


def walk(factor: float = 1.0, noise: float = 0.0, frames: int = 40) -> Trajectory:
    """Two degrees from frame to frame, times a factor, and noise in degrees, around odd axes."""
    g = np.random.default_rng(0)
    steps = g.normal((0, 2, 0), 0.5, (frames, 3))
    R = Rotation.identity()
    T = np.tile(np.eye(4), (frames, 1, 1))
    for n in range(frames):
        R = R * Rotation.from_rotvec(factor * steps[n], degrees=True)
        wrong = Rotation.from_rotvec(noise * g.normal(0, 1, 3), degrees=True)
        T[n, :3, :3] = (R * wrong).as_matrix()
        T[n, :3, 3] = g.normal(0, 1, 3)
    return Trajectory(np.arange(frames) / 30, T, np.ones(frames, bool))


@pytest.mark.parametrize(
    ("other", "alike"),
    [
        (walk(), True),
        (walk(noise=0.2), True),
        (walk(factor=1.1), True),  # another focal length
        (walk(factor=0.5), False),
        (walk(factor=-1.0), False),
        (walk(noise=5.0), False),
    ],
)
def test_other_turns_are_noticed_whatever_the_world(other: Trajectory, alike: bool):
    S = Rotation.from_euler("xyz", [40, 20, 10], degrees=True).as_matrix()
    turned = other.T_wc.copy()
    turned[:, :3] = S @ turned[:, :3]
    assert rotations_agree(walk(), Trajectory(other.timestamps, turned, other.tracked)) is alike


def test_only_frames_count_that_both_place():
    other = walk(factor=0.5)
    few = np.arange(40) < 14
    assert rotations_agree(walk(), Trajectory(other.timestamps, other.T_wc, few))
    half = np.arange(40) % 2 == 0
    some = Trajectory(other.timestamps[half], other.T_wc[half], other.tracked[half])
    assert not rotations_agree(walk(), some)


@pytest.mark.parametrize(("turn", "is_broken"), [(25.0, False), (35.0, True)])
def test_a_single_joint_of_two_parts_that_turns_otherwise_is_noticed(turn, is_broken):
    R = Rotation.from_euler("y", turn, degrees=True).as_matrix()
    other = walk()
    other.T_wc[20:, :3] = R @ other.T_wc[20:, :3]
    some = np.arange(40) % 3 == 0
    sharp = Trajectory(other.timestamps[some], other.T_wc[some], other.tracked[some])
    assert has_wrong_joint(walk(), sharp) is is_broken
    assert rotations_agree(walk(), other)
    lost = np.arange(40) != 19  # what tracking says of a turn during which it was lost is no truth
    assert not has_wrong_joint(Trajectory(other.timestamps, walk().T_wc, lost), sharp)
