"""What may be read in any order is read by several threads, and comes in order."""

import threading

import pytest

from geogs.io.sources.reader import READERS, read_side_by_side


def test_it_comes_in_order_whoever_is_first():
    later = threading.Event()

    def read(place: int) -> int:
        if place == 1:
            later.set()
        if place == 0:
            assert later.wait(10)  # the second is read while the first is not done
        return place * place

    assert list(read_side_by_side(read, range(20))) == [n * n for n in range(20)]


def test_no_more_is_read_than_may_soon_be_asked_for():
    seen = []

    def read(place: int) -> int:
        seen.append(place)
        return place

    reading = read_side_by_side(read, range(100))
    assert next(reading) == 0
    reading.close()
    assert len(seen) <= READERS + 1


def test_an_error_comes_where_its_item_would():
    def read(place: int) -> int:
        if place == 3:
            raise ValueError("gone")
        return place

    reading = read_side_by_side(read, range(9))
    assert [next(reading) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(ValueError, match="gone"):
        next(reading)
