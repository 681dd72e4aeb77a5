"""Arguments of public functions, checked by their annotations."""

import functools
import inspect
import types
from collections.abc import Callable, Sequence
from numbers import Integral, Real
from typing import Annotated, Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin
from typing import get_type_hints as hints_of

from geogs.errors import InputError

P = ParamSpec("P")
R = TypeVar("R")

_NUMBERS = {float: Real, int: Integral}


def checks_arguments(function: Callable[P, R]) -> Callable[P, R]:
    """Let a function raise InputError for arguments that its annotations do not allow.

    Arrays are left to the function: only that says what is wrong with one.
    """
    signature = inspect.signature(function)
    hints = functools.cache(lambda: hints_of(function))
    name = function.__qualname__.removesuffix(".__init__")

    @functools.wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
        for argument, value in signature.bind(*args, **kwargs).arguments.items():
            _check(f"{name}: {argument}", value, hints().get(argument, Any))
        return function(*args, **kwargs)

    return wrapped


def check_fields(record: object) -> None:
    """Raise InputError if a field of a dataclass is not what its annotation says."""
    kind: type[Any] = type(record)
    for field, hint in _fields(kind).items():
        _check(f"{kind.__name__}: {field}", getattr(record, field), hint)


@functools.cache
def _fields(kind: type) -> dict[str, Any]:
    return hints_of(kind)


def _check(what: str, value: object, hint: Any) -> None:
    if not _fits(value, hint):
        shown = repr(value) if isinstance(value, str | int | float) else type(value).__name__
        raise InputError(f"{what} is {shown}; give {' or '.join(_words(hint))}.")


def _fits(value: object, hint: Any) -> bool:
    """Whether a value is of the annotated type; types that are not known here fit."""
    origin = get_origin(hint)
    inner = get_args(hint)
    if origin in (Union, types.UnionType):
        return any(_fits(value, part) for part in inner)
    if origin is Literal:
        return isinstance(value, str) and value in inner
    if origin is Annotated:
        return _fits(value, inner[0])
    if origin is Sequence:
        if not isinstance(value, Sequence) or isinstance(value, str):
            return False
        return all(_fits(part, inner[0]) for part in value)
    if hint in _NUMBERS:
        return isinstance(value, _NUMBERS[hint]) and not isinstance(value, bool)
    is_class = isinstance(hint, type) and origin is None and hint is not Any
    if not is_class or hint.__module__ == "jaxtyping":
        return True
    return isinstance(value, hint)


def _words(hint: Any) -> list[str]:
    """The types that an annotation allows, each in a few words."""
    origin = get_origin(hint)
    inner = get_args(hint)
    if origin in (Union, types.UnionType):
        return [word for part in inner for word in _words(part)]
    if origin is Literal:
        return [str(value) for value in inner]
    if origin is Annotated:
        return _words(inner[0])
    if origin is Sequence:
        return ["a sequence of these"]
    known = {type(None): "None", float: "a number", int: "a whole number"}
    return [known.get(hint, getattr(hint, "__name__", str(hint)))]
