"""The checks of types that all tests run under."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pytest
from jaxtyping import Float, TypeCheckError

from geogs.geometry.lie import se3_exp
from lazy_check import CALLS, EVERY, FIRST, checked, jaxtyped


def cut(length: int) -> Callable:
    """A function of its own that keeps so many numbers, and says that it keeps all."""

    @jaxtyped(typechecker=checked)
    def inner(x: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        return x[:length]

    return inner


@jaxtyped(typechecker=checked)
def first(rows: Float[np.ndarray, "n 2"], count: int) -> Float[np.ndarray, "n 2"]:
    """Says that all are given."""
    return rows[:count]


@jaxtyped(typechecker=checked)
def chosen(values: list[int], side: Literal["left", "right"] = "left") -> list[int]:
    return values if side == "left" else [str(v) for v in values]  # type: ignore[misc]


@pytest.fixture
def sampled() -> Iterator[None]:
    """As in a test of the whole system."""
    CALLS.begin(all_checked=False)
    yield
    CALLS.begin(all_checked=True)


def test_arguments_and_results_are_checked_at_every_call():
    for _ in range(2 * EVERY):
        assert cut(3)(np.zeros(3)).shape == (3,)
        with pytest.raises(TypeCheckError, match="parameters"):
            cut(3)(np.zeros((3, 3)))
        with pytest.raises(TypeCheckError, match="return value"):
            cut(2)(np.zeros(3))


def test_a_call_of_other_kinds_than_one_that_was_right_is_checked():
    rows = np.zeros((3, 2))
    for _ in range(3):
        assert first(rows, 3).shape == (3, 2)
        with pytest.raises(TypeCheckError, match="return value"):
            first(rows, 2)
        with pytest.raises(TypeCheckError, match="return value"):
            first(rows, count=2)
        for wrong in (rows.T, rows.astype(int), rows[0], rows.tolist()):
            with pytest.raises(TypeCheckError, match="parameters"):
                first(wrong, 3)
        with pytest.raises(TypeCheckError, match="parameters"):
            first(rows, "3")


def test_what_lists_and_words_hold_is_looked_at_each_time():
    for _ in range(3):
        assert chosen([1, 2]) == [1, 2]
        with pytest.raises(TypeCheckError, match="parameters"):
            chosen(["1"])
        with pytest.raises(TypeCheckError, match="parameters"):
            chosen([1], "up")
        with pytest.raises(TypeCheckError, match="return value"):
            chosen([1], "right")


@pytest.mark.usefixtures("sampled")
def test_a_long_run_checks_the_first_calls_and_then_one_of_many():
    found = []
    for _ in range(4 * EVERY):
        try:
            cut(2)(np.zeros(3))
            found.append(False)
        except TypeCheckError:
            found.append(True)
    assert all(found[:FIRST])
    assert [k + 1 for k in range(FIRST, 4 * EVERY) if found[k]] == [EVERY * n for n in (1, 2, 3, 4)]
    CALLS.begin(all_checked=False)
    with pytest.raises(TypeCheckError):
        cut(2)(np.zeros(3))


@pytest.mark.usefixtures("sampled")
def test_sizes_that_a_function_asks_for_are_those_of_its_call():
    @jaxtyped(typechecker=checked)
    def is_vector(x: np.ndarray) -> bool:
        return isinstance(x, Float[np.ndarray, "n"])

    @jaxtyped(typechecker=checked)
    def are_vectors() -> list[bool]:
        return [is_vector(np.zeros(n)) for n in range(1, 3 * FIRST)]

    assert all(are_vectors())


def test_records_are_checked_when_they_are_made():
    @jaxtyped(typechecker=checked)
    @dataclass(frozen=True)
    class Pair:
        a: Float[np.ndarray, "n"]
        b: Float[np.ndarray, "n"]

    assert Pair(np.zeros(2), np.ones(2)).b.sum() == 2
    with pytest.raises(TypeCheckError, match="parameters"):
        Pair(np.zeros(2), np.ones(3))


def test_the_functions_of_the_system_are_checked():
    with pytest.raises(TypeCheckError):
        se3_exp("a vector")
