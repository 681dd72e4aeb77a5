"""Arguments of public functions, checked by their annotations."""

import functools
import inspect
import types
from collections.abc import Callable, Sequence
from typing import Any, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

from geogs.config.setting import Kind
from geogs.errors import InputError

P = ParamSpec("P")
R = TypeVar("R")


def checks_arguments(function: Callable[P, R]) -> Callable[P, R]:
    """Let a function raise InputError for arguments that its annotations do not allow.

    Arrays are left to the function: only that says what is wrong with one.
    """
    signature = inspect.signature(function)
    name = function.__qualname__.removesuffix(".__init__")

    @functools.wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
        hints = _hints(function)
        for argument, value in signature.bind(*args, **kwargs).arguments.items():
            _check(f"{name}: {argument}", value, hints.get(argument, Any))
        return function(*args, **kwargs)

    return wrapped


def check_fields(record: object) -> None:
    """Raise InputError if a field of a dataclass is not what its annotation says."""
    kind: Any = type(record)
    for field, hint in _hints(kind).items():
        _check(f"{kind.__name__}: {field}", getattr(record, field), hint)


@functools.cache
def _hints(owner: Any) -> dict[str, Any]:
    return get_type_hints(owner, include_extras=True)


def _check(what: str, value: object, hint: Any) -> None:
    if not _fits(value, hint):
        shown = repr(value) if isinstance(value, str | int | float) else type(value).__name__
        raise InputError(f"{what} is {shown}; give {' or '.join(map(_words, _parts(hint)))}.")


def _parts(hint: Any) -> tuple[Any, ...]:
    return get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)


@functools.cache
def _kind(hint: Any) -> Kind | None:
    """The kind of a text, path, number or choice; None for other types."""
    try:
        return Kind.of(hint)
    except TypeError:
        return None


def _fits(value: object, hint: Any) -> bool:
    """Whether a value is of the annotated type; types that are not known here fit."""
    parts = _parts(hint)
    if len(parts) > 1:
        return any(_fits(value, part) for part in parts)
    if get_origin(hint) is Sequence and isinstance(value, Sequence) and not isinstance(value, str):
        return all(_fits(part, get_args(hint)[0]) for part in value)
    if (kind := _kind(hint)) is not None:
        return kind.allows(value)
    hint = get_origin(hint) or hint
    is_array = getattr(hint, "__module__", "") == "jaxtyping"
    return hint is Any or is_array or not isinstance(hint, type) or isinstance(value, hint)


def _words(hint: Any) -> str:
    kind = _kind(hint)
    if kind is not None:
        return str(kind)
    if hint is type(None):
        return "none"
    is_several = get_origin(hint) is Sequence
    return "a sequence of these" if is_several else getattr(hint, "__name__", str(hint))
