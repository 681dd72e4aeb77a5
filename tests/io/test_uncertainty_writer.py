"""The table of what is known of every frame."""

import numpy as np

from geogs.io.writers.uncertainty import HEADER, write_uncertainty
from geogs.types import Trajectory, Uncertainty


def test_frames_lie_between_their_keyframes(tmp_path):
    times = np.array([0.0, 0.5, 1.0, 1.5])
    tracked, turned = np.array([1, 1, 0, 0], bool), np.array([0, 0, 0, 1], bool)
    trajectory = Trajectory(times, np.tile(np.eye(4), (4, 1, 1)), tracked, turned)
    known = Uncertainty(
        np.array([0.0, 1.0]), np.array([0.0, 0.2]), np.radians([1.0, 3.0]), np.array([0.1, np.inf])
    )
    write_uncertainty(tmp_path / "known.csv", trajectory, known)
    rows = (tmp_path / "known.csv").read_text().splitlines()
    assert rows == [
        HEADER, "0.0,tracked,0,1,0.1", "0.5,tracked,0.1,2,inf", "1.0,lost,,,",
        "1.5,orientation only,,,",
    ]  # fmt: skip


def test_without_keyframes_nothing_is_known(tmp_path):
    none = np.zeros(0)
    trajectory = Trajectory(np.zeros(1), np.eye(4)[None], np.ones(1, bool))
    write_uncertainty(tmp_path / "known.csv", trajectory, Uncertainty(none, none, none, none))
    assert (tmp_path / "known.csv").read_text().splitlines()[1] == "0.0,tracked,inf,inf,inf"
