"""Read PLY files: text or binary of either byte order, any elements and properties.

The format is that of Turk (1994): a header lists elements (tables) and their properties (columns),
then come the rows. A property is a number, or a list of numbers with its length before it.

Read by hand, as files are not trusted: trimesh is no faster, would be a dependency, and has no
one-sentence errors for damaged files.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64, Int64, Shaped

from geogs.errors import InputError
from geogs.guard.documents import in_short, read_bytes

_KINDS = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
_Order = Literal["<", ">"]
_ORDERS: dict[str, _Order | None] = {
    "ascii": None,
    "binary_little_endian": "<",
    "binary_big_endian": ">",
}
LARGEST_PLY = 1 << 35
"""Largest file in bytes."""


@dataclass(frozen=True, slots=True)
class PlyLists:
    """A list of numbers for each row."""

    values: Shaped[np.ndarray, "m"]
    """All lists, one after the other."""
    lengths: Int64[np.ndarray, "n"]


@dataclass(frozen=True, slots=True)
class PlyElement:
    """A table: its properties by their names."""

    columns: dict[str, Shaped[np.ndarray, "n"]]
    """Properties of one number a row, in the type that the header gives."""
    lists: dict[str, PlyLists]


@dataclass(frozen=True, slots=True)
class _Property:
    name: str
    kind: np.dtype
    """Type of its numbers."""
    stored: np.dtype
    """Type and byte order in which they are stored; text is stored as double precision."""
    stored_length: np.dtype | None
    """Type and byte order of the length before each list; none for single numbers."""

    @property
    def prefix(self) -> str:
        """Name of the field with the length of a list; no property is called so."""
        return f"length of {self.name}"

    def fields(self, length: int) -> list[tuple[Any, ...]]:
        """Fields of a NumPy record for this property of a row, with a list of ``length``."""
        if self.stored_length is None:
            return [(self.name, self.stored)]
        return [(self.prefix, self.stored_length), (self.name, self.stored, (length,))]


class _WrongPly(ValueError):
    """An error with a message of our own, which quotes little of the file."""


def read_ply(path: str | Path) -> dict[str, PlyElement]:
    """The elements of a PLY file by name. Lists of one length in all rows are read at once.

    Raises:
        InputError: the file is missing, cannot be read, is no PLY or is cut off.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path} does not exist; give a PLY file.")
    try:
        data = read_bytes(path, LARGEST_PLY)
        text, layout, start = _header(data)
        if text:
            data = _numbers(data[start:]).tobytes()
            start = 0
        elements = {}
        for name, (count, properties) in layout.items():
            elements[name], start = _element(data, start, name, count, properties)
    except (ValueError, OverflowError, MemoryError) as error:
        why = f" ({in_short(error)})" if isinstance(error, _WrongPly) else ""
        raise InputError(f"{path} is no readable PLY file{why}.") from None
    return elements


def _numbers(text: bytes) -> Float64[np.ndarray, "n"]:
    try:
        return np.array(text.split(), np.float64)
    except ValueError:
        raise _WrongPly("could not convert a word of its rows to a number") from None


def _header(data: bytes) -> tuple[bool, dict[str, tuple[int, list[_Property]]], int]:
    """Whether the rows are text, number of rows and properties by element, and where rows begin."""
    end = data.find(b"end_header")
    start = data.find(b"\n", end) + 1
    lines = data[: max(end, 0)].decode("ascii", "replace").splitlines()
    if not data.startswith(b"ply") or end < 0 or not start:
        raise _WrongPly("it has no header")
    order: _Order | Literal[""] | None = ""
    layout: dict[str, tuple[int, list[_Property]]] = {}
    for words in map(str.split, lines[1:]):
        match words:
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", name, _] if name in _ORDERS:
                order = _ORDERS[name]
            case ["element", name, count] if count.isdecimal() and name not in layout:
                layout[name] = int(count), []
            case ["property", *kinds, name] if layout and order != "":
                properties = next(reversed(layout.values()))[1]
                if any(name == other.name for other in properties):
                    raise _WrongPly(f"the property {name} is there twice")
                properties.append(_property(name, kinds, order))
            case _:
                raise _WrongPly(f"its header says '{' '.join(words)[:80]}'")
    if order == "":
        raise _WrongPly("its header names no format")
    return order is None, layout, start


def _property(name: str, kinds: list[str], order: _Order | None) -> _Property:
    types = [np.dtype(_KINDS[word]) for word in kinds if word in _KINDS]
    stored = [np.dtype("f8") if order is None else kind.newbyteorder(order) for kind in types]
    if len(kinds) == len(types) == 1:
        return _Property(name, types[0], stored[0], None)
    if kinds[:1] == ["list"] and len(kinds) == 3 and len(types) == 2 and types[0].kind in "iu":
        return _Property(name, types[1], stored[1], stored[0])
    raise _WrongPly(f"the type of the property {name} is '{' '.join(kinds)[:80]}'")


def _element(
    data: bytes, start: int, name: str, count: int, properties: list[_Property]
) -> tuple[PlyElement, int]:
    """The rows that begin at ``start``, and where they end."""
    smallest = sum((p.stored_length or p.stored).itemsize for p in properties)
    if count * smallest > len(data) - start:
        raise _WrongPly(f"it is cut off: {count} rows of {name} are not there")
    values, lengths, end = _rows(data, start, count, properties)
    columns = {}
    lists = {}
    for p, stored, length in zip(properties, values, lengths.T, strict=True):
        if p.stored_length is None:
            columns[p.name] = _declared(stored, p)
        else:
            lists[p.name] = PlyLists(_declared(stored, p), length)
    return PlyElement(columns, lists), end


def _rows(
    data: bytes, start: int, count: int, properties: list[_Property]
) -> tuple[list[np.ndarray], np.ndarray, int]:
    """Numbers of each property as stored, how many a row (n, properties), and where rows end."""
    if not count or not properties:
        return [np.zeros(0)] * len(properties), np.zeros((0, len(properties)), np.int64), start
    _, lengths, _ = _walk(data, start, 1, properties)
    record = np.dtype(
        [field for p, n in zip(properties, lengths[0], strict=True) for field in p.fields(int(n))]
    )
    if count * record.itemsize <= len(data) - start:
        rows = np.frombuffer(data, record, count, start)
        prefixes = [
            (p.prefix, n) for p, n in zip(properties, lengths[0], strict=True) if p.stored_length
        ]
        if all((rows[prefix] == n).all() for prefix, n in prefixes):
            values = [rows[p.name].reshape(-1) for p in properties]
            return values, np.repeat(lengths, count, axis=0), start + rows.nbytes
    starts, lengths, end = _walk(data, start, count, properties)
    columns = zip(properties, starts.T, lengths.T, strict=True)
    return [_gathered(data, at, n, p.stored) for p, at, n in columns], lengths, end


def _walk(
    data: bytes, start: int, count: int, properties: list[_Property]
) -> tuple[np.ndarray, np.ndarray, int]:
    """Offset and count of the numbers of each row and property, and the end of the rows."""
    starts, lengths = np.ones((2, count, len(properties)), np.int64)
    at = start
    for row in range(count):
        for i, p in enumerate(properties):
            if p.stored_length is not None:
                (length,) = np.frombuffer(data, p.stored_length, 1, at).tolist()
                if length < 0 or length != int(length):
                    raise _WrongPly(f"a list of {p.name} has length {length}")
                lengths[row, i] = length
                at += p.stored_length.itemsize
            starts[row, i] = at
            at += p.stored.itemsize * int(lengths[row, i])
        if at > len(data):
            raise _WrongPly("it is cut off")
    return starts, lengths, at


def _gathered(data: bytes, starts: np.ndarray, lengths: np.ndarray, stored: np.dtype) -> np.ndarray:
    """``lengths`` numbers from each of ``starts``, one after the other."""
    before = np.cumsum(lengths) - lengths
    at = np.repeat(starts - stored.itemsize * before, lengths)
    at += stored.itemsize * np.arange(len(at))
    table = np.frombuffer(data, np.uint8)[at[:, None] + np.arange(stored.itemsize)]
    return table.view(stored)[:, 0]


def _declared(stored: np.ndarray, p: _Property) -> np.ndarray:
    """The numbers in the type that the header gives them."""
    with np.errstate(invalid="ignore", over="ignore"):
        numbers = stored.astype(p.kind)
    if p.kind.kind in "iu" and (numbers != stored).any():
        raise _WrongPly(f"{p.name} holds what is no {p.kind}")
    return numbers
