"""Run-time checks of types that are made when a function is first called, and once.

To prepare a check takes its time for each function, and most are never called by a process that
runs a part of the tests. To check takes longer than many a function itself: in tests of the whole
system, which call some a hundred thousand times, the first calls of each function are checked and
then one of many; everywhere else all are. A call with values of the same kinds as one that was
right, of the same types and shapes, is right as well.
"""

import contextlib
import dataclasses
import inspect
import threading
import types
from collections.abc import Callable
from functools import partial, wraps
from typing import Any, ParamSpec, TypeVar, get_type_hints

import jaxtyping
import numpy as np
import torch
from beartype import beartype
from beartype.roar import BeartypeCallHintReturnViolation, BeartypeCallHintViolation

P, R = ParamSpec("P"), TypeVar("R")
FIRST, EVERY = 8, 32
"""Calls of a function that are checked in a test of the whole system: the first, then one of so
many."""


KEPT = 256
"""Kinds of arguments that are kept of a function."""
ARRAYS = (torch.Tensor, torch.nn.Parameter, np.ndarray)
BY_TYPE = (bool, int, float, type(None), types.FunctionType, types.MethodType)
OWNERS = ("geogs", "torch", "numpy", "pathlib")


class Untold(Exception):
    """Whether a value is of a type depends on more than its kind."""


class _Plain(dict[type, bool]):
    """Whether a type alone tells of its values, which then hold nothing that is looked into."""

    def __missing__(self, kind: type) -> bool:
        holds = any("__iter__" in vars(c) or "__getitem__" in vars(c) for c in kind.__mro__)
        owned = kind.__module__.partition(".")[0].partition("_")[0] in OWNERS
        self[kind] = kind in BY_TYPE or (owned and not holds and not issubclass(kind, type))
        return self[kind]


PLAIN = _Plain()


def kind_of(value: object) -> object:
    """All of a value that its check depends on."""
    kind = type(value)
    if kind in ARRAYS:
        return kind, value.dtype, value.shape
    if PLAIN[kind]:
        return kind
    if kind is str:
        return value
    if kind is tuple:
        return tuple([kind_of(v) for v in value])
    raise Untold


def kinds_of(args: tuple, kwargs: dict[str, object]) -> object:
    """The kinds of all arguments of a call."""
    if kwargs:
        return kind_of(args), tuple([(name, kind_of(v)) for name, v in kwargs.items()])
    return tuple([kind_of(v) for v in args])


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
    """Functions within others between the check of their arguments and their call, and results
    whose check has begun."""

    def __init__(self) -> None:
        self.functions: list[Callable] = []
        self.results: list[object] = []


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
    names = _texts_of(function)
    if inspect.isgeneratorfunction(function):
        check = _jaxtyped(function, typechecker=typechecker)
    else:
        check = _named(typechecker(_annotated(function, names) if names else function))

    if inspect.isgeneratorfunction(function) or "<locals>" in function.__qualname__:
        known = None
    else:
        known = _KnownKinds(function, check, typechecker)

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        if not CALLS.are_all_checked:
            count[0] += 1
            if count[0] > FIRST and count[0] % EVERY:
                with _own_names:
                    return function(*args, **kwargs)
        return check(*args, **kwargs) if known is None else known.call(args, kwargs)

    return call


class _KnownKinds:
    """Checks a call unless one of the same kinds was right."""

    def __init__(self, function: Callable, check: Callable, typechecker: Callable) -> None:
        self._function, self._check, self._typechecker = function, check, typechecker
        self._right: dict[object, set[object]] = {}
        self._again: Callable | None = None
        code = function.__code__
        is_bare = code.co_argcount and code.co_varnames[0] not in function.__annotations__
        self._begin = int(bool(is_bare))
        """The first argument of which a type is told; of ``self`` none is."""

    def call(self, args: tuple, kwargs: dict[str, object]) -> Any:
        try:
            given = kinds_of(args[self._begin :], kwargs)
        except Untold:
            return self._check(*args, **kwargs)
        results = self._right.get(given)
        if results is None:
            result = self._check(*args, **kwargs)
            if len(self._right) < KEPT:
                self._right[given] = set()
                self._keep(given, result)
            return result
        if not results:  # its results are none of which the kind tells all
            return self._check(*args, **kwargs)
        with _own_names:
            result = self._function(*args, **kwargs)
        try:
            if kind_of(result) in results:
                return result
        except Untold:
            pass
        self._check_result(result, args, kwargs)
        self._keep(given, result)
        return result

    def _keep(self, given: object, result: object) -> None:
        with contextlib.suppress(Untold):
            self._right[given].add(kind_of(result))

    def _check_result(self, result: object, args: tuple, kwargs: dict[str, object]) -> None:
        """Check what a call has given already."""
        if self._again is None:

            @wraps(self._function)
            def last(*_: object, **__: object) -> object:
                return _TO_CALL.results.pop()

            self._again = _named(self._typechecker(_annotated(last, _texts_of(last))))
        _TO_CALL.results.append(result)
        try:
            self._again(*args, **kwargs)
        except jaxtyping.TypeCheckError:
            _TO_CALL.results.clear()
            raise


def _annotated(function: Callable[P, R], types: dict[str, object]) -> Callable[P, R]:
    """The function with other types for some of its arguments."""

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        return function(*args, **kwargs)

    call.__annotations__ = {**function.__annotations__, **types}
    return call


def _texts_of(function: Callable) -> dict[str, object]:
    """The types that a function's annotations tell of by a text."""
    told = function.__annotations__.items()
    return {name: _resolved(t, function) for name, t in told if isinstance(t, str)}


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
