"""Run-time checks of types that are made when a function is first called.

Beartype writes a function for each that it checks, which takes a fifth of the time that pytest
needs to collect all tests; most are never called by a process that runs a part of the tests.
"""

from collections.abc import Callable
from typing import ParamSpec, TypeVar

from beartype import beartype

P, R = ParamSpec("P"), TypeVar("R")


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """The function with its arguments and its result checked by beartype."""
    made: Callable[P, R] | None = None

    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        nonlocal made
        if made is None:
            made = beartype(function)
        return made(*args, **kwargs)

    return call
