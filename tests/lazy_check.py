"""Run-time checks of types that are made when a function is first called, and once.

Beartype writes a function for each that it checks, which takes a fifth of the time that pytest
needs to collect all tests; most are never called by a process that runs a part of the tests. A
function within another is a new one with each call of that, but what checks it stays.
"""

from collections.abc import Callable
from typing import ParamSpec, TypeVar

from beartype import beartype

P, R = ParamSpec("P"), TypeVar("R")

_inner: dict[tuple[str, str, str], Callable] = {}
"""What checks functions within others, by module, name and annotations.

jaxtyping has empty twins of functions checked, which differ in nothing else.
"""


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """The function with its arguments and its result checked by beartype."""
    made: Callable[P, R] | None = None

    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        nonlocal made
        if made is None:
            made = _checker(function)
        return made(*args, **kwargs)

    return call


def _checker(function: Callable[P, R]) -> Callable[P, R]:
    if "<locals>" not in function.__qualname__:
        return beartype(function)
    key = (function.__module__, function.__qualname__, str(function.__annotations__))
    if key not in _inner:
        _inner[key] = beartype(function)
    return _inner[key]
