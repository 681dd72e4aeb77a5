"""Kinds of stored records: declarations of their fields, numbers, arrays and references.

A kind is a type annotation; ``Annotated`` adds limits of a number or an array, see
:mod:`geogs.limits`.
"""

import hashlib
import types
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

from jaxtyping import AbstractArray


class Part(NamedTuple):
    """A number, a text or an array of a record."""

    place: str
    kind: Any
    """Type without the marks of ``Annotated``."""
    marks: tuple[object, ...]
    value: Any


def plain(kind: Any) -> Any:
    """Return a kind without the marks of ``Annotated``."""
    return get_args(kind)[0] if get_origin(kind) is Annotated else kind


def marks_of(kind: Any) -> tuple[object, ...]:
    """Return the marks of ``Annotated`` on a kind."""
    return get_args(kind)[1:] if get_origin(kind) is Annotated else ()


def is_record(kind: Any) -> bool:
    """Whether a kind is a dataclass or a named tuple."""
    is_named_tuple = isinstance(kind, type) and issubclass(kind, tuple) and hasattr(kind, "_fields")
    return is_named_tuple or (isinstance(kind, type) and is_dataclass(kind))


def is_array(kind: Any) -> bool:
    """Whether a kind is a jaxtyping array."""
    return isinstance(kind, type) and issubclass(kind, AbstractArray)


def is_union(kind: Any) -> bool:
    """Whether a kind is a union."""
    return get_origin(kind) in (Union, types.UnionType)


def stored(kind: Any) -> dict[str, Any]:
    """Return names and kinds of the stored fields of a record."""
    hints = get_type_hints(kind, include_extras=True)
    if not is_dataclass(kind):
        return hints
    return {f.name: hints[f.name] for f in fields(kind) if f.metadata.get("stored", True)}


def alternatives(kind: Any) -> tuple[Any, ...]:
    """Return the kinds in a union except None."""
    return tuple(k for k in get_args(kind) if k is not type(None))


def item_kinds(kind: Any, count: int) -> list[Any]:
    """Return the kinds of the items of a list or tuple of length ``count``."""
    kinds = list(get_args(kind))
    if get_origin(kind) is list:
        return kinds * count
    return kinds[:1] * count if kinds[1:] == [...] else kinds


def fits(kind: Any, value: object) -> bool:
    """Whether a value is of a kind, without checking its items."""
    kind = plain(kind)
    if kind in (bool, int):
        return type(value) is kind
    if get_origin(kind) is Literal:
        return value in get_args(kind)
    return isinstance(value, get_origin(kind) or kind) or (kind is float and type(value) is int)


def lengths(kind: Any, value: Any) -> list[tuple[str, int]]:
    """Return the letters in the annotated shape of an (optional) array, with their lengths."""
    several = alternatives(kind) if is_union(kind) else (kind,)
    array = next((k for k in map(plain, several) if is_array(k)), None)
    if array is None or not isinstance(value, array.array_type):
        return []
    shape = zip(array.dim_str.split(), value.shape, strict=False)
    return [(x, m) for x, m in shape if x.isidentifier()]


def schema(kind: Any) -> str:
    """Hash (64 digits) of every name, type and shape that a record of the kind declares."""
    return hashlib.sha256(described(kind).encode()).hexdigest()


def described(kind: Any) -> str:
    """Describe a kind and everything nested in it."""
    kind = plain(kind)
    if is_record(kind):
        named = (f"{n}:{described(k)}" for n, k in stored(kind).items())
        return f"{kind.__name__}({','.join(named)})"
    if is_array(kind):
        return f"{kind.array_type.__name__}[{'|'.join(kind.dtypes)};{kind.dim_str}]"
    if isinstance(kind, type) and issubclass(kind, Enum):
        return f"{kind.__name__}({','.join(kind.__members__)})"
    origin = get_origin(kind)
    inner = get_args(kind)
    if origin is Literal:
        return f"Literal{list(inner)}"
    if origin is not None:
        label = "union" if is_union(kind) else origin.__name__
        return f"{label}[{','.join('...' if p is ... else described(p) for p in inner)}]"
    return str(kind.__name__)


def parts(kind: Any, record: Any, place: str = "") -> Iterator[Part]:
    """Yield every number, text and array of a record, with its path."""
    marks = marks_of(kind)
    kind = plain(kind)
    origin = get_origin(kind)
    if record is None:
        return
    if is_union(kind):
        yield from parts(next(k for k in alternatives(kind) if fits(k, record)), record, place)
    elif is_record(kind):
        for name, inner in stored(kind).items():
            yield from parts(inner, getattr(record, name), joined(place, name))
    elif origin in (list, tuple):
        for n, inner in enumerate(item_kinds(kind, len(record))):
            yield from parts(inner, record[n], joined(place, n))
    elif origin is dict:
        key, item = get_args(kind)
        for k, v in record.items():
            yield from parts(key, k, place)
            yield from parts(item, v, joined(place, k))
    else:
        yield Part(place, kind, marks, record)


def joined(place: str, part: object) -> str:
    """Return the path of a part within a record."""
    return f"{place}.{part}" if place else str(part)
