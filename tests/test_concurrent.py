"""Threads beside the one that frames come to: one errand at a time, and who goes first."""

import threading
import time

import pytest

from geogs.concurrent import BackgroundTask, PriorityGate


def test_an_errand_is_done_beside_and_waited_for():
    errand, go_on, done = BackgroundTask("errand"), threading.Event(), []
    errand.start(lambda: done.append(go_on.wait(10)))
    assert errand.is_going_on
    assert done == []
    go_on.set()
    errand.wait()
    assert done == [True]
    assert not errand.is_going_on
    errand.wait()  # there is nothing to wait for


def test_the_next_errand_waits_for_the_one_before():
    errand, order = BackgroundTask("errand"), []

    def slow() -> None:
        time.sleep(0.05)
        order.append(1)

    errand.start(slow)
    errand.start(lambda: order.append(2))
    errand.wait()
    assert order == [1, 2]


def test_what_an_errand_raises_is_raised_once_where_it_is_waited_for():
    errand = BackgroundTask("errand")
    errand.start(lambda: [][0])
    with pytest.raises(IndexError):
        errand.wait()
    errand.wait()


def test_long_work_waits_for_what_is_urgent_and_no_longer_than_allowed():
    way = PriorityGate(longest=0.1)
    start = time.perf_counter()
    way.give()
    assert time.perf_counter() - start < 0.05
    with way.taken():
        start = time.perf_counter()
        way.give()
        waited = time.perf_counter() - start
    assert 0.09 < waited < 2.0
    passed, way = threading.Event(), PriorityGate(longest=30.0)

    def work() -> None:
        way.give()
        passed.set()

    with way.taken():
        thread = threading.Thread(target=work)
        thread.start()
        assert not passed.wait(0.05)
    assert passed.wait(5)
    thread.join()
