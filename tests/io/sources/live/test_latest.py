"""Of items that come at their own pace, the newest."""

import threading
import time

import pytest

from geogs.io.sources.live.live_reader import Latest


def wait_for(condition, seconds=600.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


def test_what_is_late_gets_the_newest_and_the_rest_is_counted():
    go = threading.Semaphore(0)
    given = []

    def items():
        for n in range(7):
            go.acquire()
            given.append(n)
            yield n

    latest = Latest(items())
    go.release()
    assert latest.take() == 0
    for _ in range(5):
        go.release()
    wait_for(lambda: latest.dropped == 4)
    assert (latest.take(), latest.dropped) == (5, 4)
    go.release()
    assert latest.take() == 6
    assert latest.take() is None
    assert (given, latest.dropped) == ([*range(7)], 4)


def test_a_failure_is_told_after_what_came_before_it():
    def items():
        yield 1
        raise OSError("unplugged")

    latest = Latest(items())
    wait_for(lambda: not latest._thread.is_alive())
    assert latest.take() == 1
    with pytest.raises(OSError, match="unplugged"):
        latest.take()


def test_closing_ends_the_iterator():
    closed = threading.Event()

    def items():
        try:
            while True:
                time.sleep(0.001)
                yield 0
        finally:
            closed.set()

    latest = Latest(items())
    assert latest.take() == 0
    latest.close()
    assert closed.wait(600)
