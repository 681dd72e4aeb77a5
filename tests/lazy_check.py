"""Run-time checks of types that are made when a function is first called, and once.

To prepare a check takes its time for each function, and most are never called by a process that
runs a part of the tests. To check takes longer than many a function itself: in tests of the whole
system, which call some a hundred thousand times, the first calls of each function are checked and
then one of many; everywhere else all are.
"""

import dataclasses
import inspect
from collections.abc import Callable
from functools import partial, wraps
from typing import ParamSpec, TypeVar

import jaxtyping
from beartype import beartype

P, R = ParamSpec("P"), TypeVar("R")
FIRST, EVERY = 8, 32
"""Of the calls of a function in a test of the whole system: so many, and then one of so many."""


class Calls:
    """Counts the calls of each function in a test, and says which are checked."""

    def __init__(self) -> None:
        self.are_all_checked = True
        self._counts: dict[tuple[str, str, int], list[int]] = {}

    def begin(self, all_checked: bool) -> None:
        """Count anew."""
        self.are_all_checked = all_checked
        if not all_checked:
            for count in self._counts.values():
                count[0] = 0

    def count_of(self, function: Callable) -> list[int]:
        """What counts its calls; functions made again and again within another are one."""
        key = (function.__module__, function.__qualname__, function.__code__.co_firstlineno)
        return self._counts.setdefault(key, [0])


CALLS = Calls()

_inner: dict[tuple[str, str, str], Callable] = {}
"""What checks functions within others, by module, name and annotations.

jaxtyping has empty twins of functions checked, which differ in nothing else.
"""
_jaxtyped = jaxtyping.jaxtyped
_own_names = _jaxtyped("context")
"""In which sizes have names of their own, as in a call that is checked."""


def jaxtyped(
    function: Callable[P, R] | type | None = None, *, typechecker: Callable
) -> Callable[P, R] | type | Callable:
    """What jaxtyping decorates functions and dataclasses with, not at work at every call."""
    if function is None:
        return partial(jaxtyped, typechecker=typechecker)
    if inspect.isclass(function):
        made = vars(function).get("__init__")
        if dataclasses.is_dataclass(function) and made and not hasattr(made, "__wrapped__"):
            function.__init__ = jaxtyped(made, typechecker=typechecker)
        return function
    check, count = _jaxtyped(function, typechecker=typechecker), CALLS.count_of(function)

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        if not CALLS.are_all_checked:
            count[0] += 1
            if count[0] > FIRST and count[0] % EVERY:
                with _own_names:
                    return function(*args, **kwargs)
        return check(*args, **kwargs)

    return call


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
