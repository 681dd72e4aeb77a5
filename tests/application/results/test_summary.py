"""``summary.json``: the parts of it that are worked out."""

import numpy as np
import pytest

from geogs.application.results.summary import state_spans, time_summary
from geogs.stopwatch import Stopwatch
from geogs.types import Trajectory


def test_rates_count_every_stage():
    """Up to the end of the stream loops, map updates and adjustments on the way count, too."""
    stopwatch = Stopwatch()
    stopwatch.times.seconds = {
        "reading": 0.25, "tracking": 2.0, "loops": 0.5, "mapping": 1.0, "pose refinement": 0.25,
        "global bundle adjustment": 0.75, "map update": 0.25,
    }  # fmt: skip
    stopwatch.end_stream()
    stopwatch.times.seconds |= {"map update": 0.5, "final mapping": 2.75, "mesh": 2.0}
    summary = time_summary(stopwatch, frames=40)
    assert summary["frames_per_second"] == {"until_stream_end": 8.0, "with_final_stages": 4.0}
    assert summary["seconds"] == {**stopwatch.seconds, "total": 10.0}


def test_what_knows_no_stream_has_one_rate():
    stopwatch = Stopwatch()
    stopwatch.times.seconds = {"depth": 4.0, "mesh": 1.0}
    assert time_summary(stopwatch, 10)["frames_per_second"] == {"with_final_stages": 2.0}


@pytest.mark.parametrize(
    ("tracked", "expected"),
    [
        ([1, 1, 1, 1, 1], []),
        ([0, 1, 0, 0, 1], [[0.0, 0.0], [1.0, 1.5]]),
        ([0, 0, 0, 0, 0], [[0.0, 2.0]]),
    ],
)
def test_lost_spans_begin_and_end_with_lost_frames(tracked, expected):
    times = 0.5 * np.arange(5)
    poses = np.tile(np.eye(4), (5, 1, 1))
    assert state_spans(Trajectory(times, poses, np.array(tracked, bool)), "lost") == expected
