"""Seconds per stage: what overlaps counts once, and the stream has an end."""

import threading
from copy import deepcopy

import pytest

from geogs import stopwatch as module
from geogs.stopwatch import Stopwatch


@pytest.fixture
def pass_time(monkeypatch):
    """A clock that only goes on when it is told to."""
    now = [100.0]
    monkeypatch.setattr(module.time, "perf_counter", lambda: now[0])

    def go_on(seconds: float) -> None:
        now[0] += seconds

    return go_on


def test_a_stage_inside_another_counts_for_the_outer_one(pass_time):
    stopwatch = Stopwatch()
    with stopwatch("mapping"):
        pass_time(1.0)
        with stopwatch("rendering"):
            pass_time(2.0)
    pass_time(50.0)
    with stopwatch("mapping"):
        pass_time(0.5)
    assert stopwatch.seconds == {"mapping": 3.5}


def test_the_stream_ends_once_all_its_stages_are_counted(pass_time):
    stopwatch = Stopwatch()
    for stage, seconds in (("tracking", 4.0), ("loops", 1.0), ("map update", 2.0)):
        with stopwatch(stage):
            pass_time(seconds)
    assert stopwatch.until_stream_end is None
    stopwatch.end_stream()
    with stopwatch("map update"):
        pass_time(8.0)
    assert stopwatch.until_stream_end == 7.0
    assert stopwatch.total == 15.0


def test_a_stage_that_fails_is_counted_and_ends(pass_time):
    stopwatch = Stopwatch()

    def fail() -> None:
        with stopwatch("mesh"):
            pass_time(3.0)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    with stopwatch("report"):
        pass_time(1.0)
    assert stopwatch.seconds == {"mesh": 3.0, "report": 1.0}


def test_one_that_goes_on_from_where_another_was_does_not_run(pass_time):
    stopwatch = Stopwatch()
    with stopwatch("tracking"):
        pass_time(1.0)
    stopwatch.end_stream()
    with stopwatch("checkpoints"):
        again = Stopwatch(deepcopy(stopwatch.times))
    with again("mesh"):
        pass_time(2.0)
    assert again.seconds == {"tracking": 1.0, "mesh": 2.0}
    assert again.until_stream_end == 1.0
    assert stopwatch.seconds.keys() == {"tracking", "checkpoints"}


def test_what_a_thread_does_aside_does_not_count(pass_time):
    stopwatch = Stopwatch()

    def work() -> None:
        with stopwatch.aside(), stopwatch("mapping"):
            pass_time(4.0)

    with stopwatch("tracking"):
        pass_time(1.0)
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert stopwatch.seconds == {"tracking": 1.0}
    with stopwatch("mapping"):
        pass_time(0.5)
    assert stopwatch.seconds == {"tracking": 1.0, "mapping": 0.5}
