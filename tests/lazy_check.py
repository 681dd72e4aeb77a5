"""Run-time checks of types that are made when a function is first called, and once.

To prepare a check takes its time for each function, and most are never called by a process that
runs a part of the tests. To check takes longer than many a function itself: in tests of the whole
system, which call some a hundred thousand times, the first calls of each function are checked and
then one of many; everywhere else all are.
"""

import dataclasses
import inspect
import threading
from collections.abc import Callable
from functools import partial, wraps
from typing import Any, ParamSpec, TypeVar, get_type_hints

import jaxtyping
from beartype import beartype
from beartype.roar import BeartypeCallHintReturnViolation, BeartypeCallHintViolation

P, R = ParamSpec("P"), TypeVar("R")
FIRST, EVERY = 8, 32
"""Calls of a function that are checked in a test of the whole system: the first, then one of so
many."""


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
        """Counter of its calls; functions made again and again within another are one."""
        key = (function.__module__, function.__qualname__, function.__code__.co_firstlineno)
        return self._counts.setdefault(key, [0])


CALLS = Calls()

_inner: dict[tuple[str, str, str], Callable] = {}
"""Checked versions of functions within others, by module, name and annotations; made once."""
_jaxtyped = jaxtyping.jaxtyped
_own_names = _jaxtyped("context")
"""In which sizes have names of their own, as in a call that is checked."""


class _ToCall(threading.local):
    """Functions within others between the check of their arguments and their call."""

    def __init__(self) -> None:
        self.functions: list[Callable] = []


_TO_CALL = _ToCall()


def jaxtyped(
    function: Callable[P, R] | type | None = None, *, typechecker: Callable
) -> Callable[P, R] | type | Callable:
    """What jaxtyping decorates functions and dataclasses with, not at work at every call.

    jaxtyping's own prepares its check where a function is defined, within others at every call of
    those, and checks arguments again with the result. Of generators, whose results jaxtyping
    treats otherwise, it does the work.
    """
    if function is None:
        return partial(jaxtyped, typechecker=typechecker)
    if inspect.isclass(function):
        made = vars(function).get("__init__")
        if dataclasses.is_dataclass(function) and made and not hasattr(made, "__wrapped__"):
            function.__init__ = jaxtyped(made, typechecker=typechecker)
        return function
    count = CALLS.count_of(function)
    names = {
        n: _resolved(t, function) for n, t in function.__annotations__.items() if isinstance(t, str)
    }
    if inspect.isgeneratorfunction(function):
        check = _jaxtyped(function, typechecker=typechecker)
    else:
        check = _named(typechecker(_annotated(function, names) if names else function))

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        if not CALLS.are_all_checked:
            count[0] += 1
            if count[0] > FIRST and count[0] % EVERY:
                with _own_names:
                    return function(*args, **kwargs)
        return check(*args, **kwargs)

    return call


def _annotated(function: Callable[P, R], types: dict[str, object]) -> Callable[P, R]:
    """The function with other types for some of its arguments."""

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        return function(*args, **kwargs)

    call.__annotations__ = {**function.__annotations__, **types}
    return call


def _resolved(annotation: object, function: Callable) -> object:
    """The type that a text, or texts within, tell of by now; any where that is none."""
    holder = lambda: None  # noqa: E731
    holder.__annotations__ = {"value": annotation}
    try:
        return get_type_hints(holder, inspect.unwrap(function).__globals__, include_extras=True)[
            "value"
        ]
    except Exception:
        return Any


def _named(checker: Callable[P, R]) -> Callable[P, R]:
    """The checker where sizes have names of their own, with jaxtyping's error."""

    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            with _own_names:
                return checker(*args, **kwargs)
        except BeartypeCallHintViolation as error:
            is_result = isinstance(error, BeartypeCallHintReturnViolation)
            part = "return value" if is_result else "parameters"
            raise jaxtyping.TypeCheckError(f"Wrong type in the {part}: {error}") from error

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
    types = {name: _resolved(t, function) for name, t in function.__annotations__.items()}
    if "<locals>" not in function.__qualname__:
        return beartype(_annotated(function, types))
    key = (function.__module__, function.__qualname__, str(function.__annotations__))
    if key not in _inner:

        def last(*args: P.args, **kwargs: P.kwargs) -> R:
            return _TO_CALL.functions.pop()(*args, **kwargs)

        _inner[key] = beartype(_annotated(wraps(function)(last), types))
    check = _inner[key]

    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        waiting = _TO_CALL.functions
        others = len(waiting)
        waiting.append(function)
        try:
            return check(*args, **kwargs)
        finally:
            del waiting[others:]

    return call
