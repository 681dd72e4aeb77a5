"""Kinds of stored records: what their classes declare of fields, numbers, arrays and references.

A kind is a type as an annotation has it; ``Annotated`` says more of a number or an array, see
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
    """Without the marks of ``Annotated``."""
    marks: tuple[object, ...]
    value: Any


def plain(kind: Any) -> Any:
    """A kind without the marks of ``Annotated``."""
    return get_args(kind)[0] if get_origin(kind) is Annotated else kind


def marks_of(kind: Any) -> tuple[object, ...]:
    """The marks of ``Annotated`` on a kind."""
    return get_args(kind)[1:] if get_origin(kind) is Annotated else ()


def is_record(kind: Any) -> bool:
    """Whether a kind is a dataclass or a named tuple."""
    is_named_tuple = isinstance(kind, type) and issubclass(kind, tuple) and hasattr(kind, "_fields")
    return is_named_tuple or (isinstance(kind, type) and is_dataclass(kind))


def is_array(kind: Any) -> bool:
    """Whether a kind is one of jaxtyping's."""
    return isinstance(kind, type) and issubclass(kind, AbstractArray)


def is_union(kind: Any) -> bool:
    """Whether a kind is one of several."""
    return get_origin(kind) in (Union, types.UnionType)


def stored(kind: Any) -> dict[str, Any]:
    """Names and kinds of the fields of a record that are stored."""
    hints = get_type_hints(kind, include_extras=True)
    if not is_dataclass(kind):
        return hints
    return {f.name: hints[f.name] for f in fields(kind) if f.metadata.get("stored", True)}


def alternatives(kind: Any) -> tuple[Any, ...]:
    """Kinds in a union, but for None."""
    return tuple(k for k in get_args(kind) if k is not type(None))


def item_kinds(kind: Any, count: int) -> list[Any]:
    """Kinds of the items of a list or tuple of so many."""
    kinds = list(get_args(kind))
    if get_origin(kind) is list:
        return kinds * count
    return kinds[:1] * count if kinds[1:] == [...] else kinds


def fits(kind: Any, value: object) -> bool:
    """Whether a value is of a kind, as far as one sees from outside."""
    kind = plain(kind)
    if kind in (bool, int):
        return type(value) is kind
    if get_origin(kind) is Literal:
        return value in get_args(kind)
    return isinstance(value, get_origin(kind) or kind) or (kind is float and type(value) is int)


def lengths(kind: Any, value: Any) -> list[tuple[str, int]]:
    """The letters in the annotated shape of an array, or of one that there may be, and lengths."""
    several = alternatives(kind) if is_union(kind) else (kind,)
    array = next((k for k in map(plain, several) if is_array(k)), None)
    if array is None or not isinstance(value, array.array_type):
        return []
    shape = zip(array.dim_str.split(), value.shape, strict=False)
    return [(x, m) for x, m in shape if x.isidentifier()]


def schema(kind: Any) -> str:
    """64 digits that change with any name, type or shape that a record of the kind declares."""
    return hashlib.sha256(described(kind).encode()).hexdigest()


def described(kind: Any) -> str:
    """A kind in words, with all that is below it."""
    kind = plain(kind)
    if is_record(kind):
        named = (f"{n}:{described(k)}" for n, k in stored(kind).items())
        return f"{kind.__name__}({','.join(named)})"
    if is_array(kind):
        return f"{kind.array_type.__name__}[{'|'.join(kind.dtypes)};{kind.dim_str}]"
    if isinstance(kind, type) and issubclass(kind, Enum):
        return f"{kind.__name__}({','.join(kind.__members__)})"
    origin, inner = get_origin(kind), get_args(kind)
    if origin is Literal:
        return f"Literal{list(inner)}"
    if origin is not None:
        label = "union" if is_union(kind) else origin.__name__
        return f"{label}[{','.join('...' if p is ... else described(p) for p in inner)}]"
    return str(kind.__name__)


def parts(kind: Any, record: Any, place: str = "") -> Iterator[Part]:
    """Every number, text and array of a record, with its place in it."""
    marks, kind = marks_of(kind), plain(kind)
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
    """The place of a part within a record."""
    return f"{place}.{part}" if place else str(part)
