"""States as plain values for JSON and named arrays, and back; nothing in a file is ever executed.

A state is a record: a dataclass or named tuple of plain values, arrays, arrays in archives, and of
lists, tuples, dictionaries, unions and records of these. It is read by the types that its class
declares, never by the file: every value is checked against its field, every array against the
dtype and shape of its jaxtyping annotation, where a letter stands for the same length throughout a
record, and every number against the limits of its field (:mod:`geogs.limits`). Fields marked
``NOT_STORED`` are left at their default.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import numpy as np
import torch
from torch import Tensor

from geogs.errors import InputError
from geogs.limits import holds
from geogs.world.archive import Archive, Archived
from geogs.world.kinds import (
    alternatives,
    described,
    fits,
    is_array,
    is_record,
    is_union,
    item_kinds,
    joined,
    lengths,
    marks_of,
    plain,
    stored,
)

Values = Any
"""JSON value: None, booleans, numbers, strings, lists and dictionaries of these."""

_PLAIN = (bool, int, float, str, type(None))


_DTYPES = frozenset({
    "bool", "uint8", "int8", "uint16", "int16", "uint32", "int32", "uint64", "int64", "float16",
    "float32", "float64",
})  # fmt: skip
"""Allowed dtypes of arrays in archives."""


@dataclass
class Packed:
    """A packed record."""

    values: Values = None
    arrays: dict[str, Tensor] = field(default_factory=dict)
    """Copies on the CPU, by their path in the record, such as ``mapper.map.position``."""
    archives: dict[str, Archive] = field(default_factory=dict)
    """Archives of arrays of the record, by name."""


def pack(kind: Any, record: object) -> Packed:
    """Pack a record of a kind (a type annotation).

    Raises TypeError if a value is not of its declared type, or cannot be stored.
    """
    packed = Packed()
    packed.values = _Packer(packed).value(kind, record, "")
    return packed


def unpack(
    kind: Any,
    values: Values,
    arrays: Mapping[str, Tensor],
    archives: Mapping[str, Archive],
    device: torch.device | str = "cpu",
    name: str = "",
) -> Any:
    """Rebuild a record of a kind; tensors that were on a GPU go to ``device``.

    ``name`` is the path of the record in the one that was packed.

    Raises InputError naming the part that is missing, superfluous, or of another type.
    """
    return _Unpacker(arrays, archives, torch.device(device)).value(kind, values, name)


# --- to plain values and arrays ------------------------------------------------------------------


class _Packer:
    def __init__(self, packed: Packed) -> None:
        self._packed = packed

    def value(self, kind: Any, value: Any, name: str) -> Values:
        """Return the JSON form of a value; store its arrays by name."""
        kind = plain(kind)
        origin = get_origin(kind)
        if is_union(kind):
            return self._one_of(kind, value, name)
        if origin is Literal:
            return value if value in get_args(kind) else self._wrong(kind, value, name)
        if not fits(kind, value):
            return self._wrong(kind, value, name)
        if is_record(kind):
            own = stored(kind).items()
            return {n: self.value(k, getattr(value, n), joined(name, n)) for n, k in own}
        if is_array(kind):
            return self._array(value, name)
        if origin in (list, tuple):
            kinds = item_kinds(kind, len(value))
            return [
                self.value(k, v, joined(name, n))
                for n, (k, v) in enumerate(zip(kinds, value, strict=True))
            ]
        if origin is dict:
            key, item = get_args(kind)
            return [
                [self.value(key, k, name), self.value(item, v, joined(name, n))]
                for n, (k, v) in enumerate(value.items())
            ]
        if kind is Archive:
            return self._archive(value)
        if kind is Archived:
            return {
                "archive": self._archive(value.archive),
                "offset": value.offset,
                "shape": list(value.shape),
                "dtype": value.dtype.name,
                "checksum": value.checksum,
            }
        if isinstance(value, Enum):
            return value.name
        return str(value) if isinstance(value, Path) else value

    def _one_of(self, kind: Any, value: Any, name: str) -> Values:
        """Return None, the form of the only alternative, or its number and form."""
        kinds = alternatives(kind)
        if value is None and type(None) in get_args(kind):
            return None
        if len(kinds) == 1:
            return self.value(kinds[0], value, name)
        for n, k in enumerate(kinds):
            if fits(k, value):
                return [n, self.value(k, value, name)]
        return self._wrong(kind, value, name)

    def _array(self, array: Tensor | np.ndarray, name: str) -> str:
        """Store a copy of an array; return "host" or "device"."""
        tensor = array if isinstance(array, Tensor) else torch.from_numpy(np.array(array))
        kept = torch.empty(tensor.shape, dtype=tensor.dtype)  # with no other memory than its own
        self._packed.arrays[name] = kept.copy_(tensor.detach())
        return "host" if tensor.device.type == "cpu" else "device"

    def _archive(self, archive: Archive) -> str:
        self._packed.archives[archive.name] = archive
        return archive.name

    @staticmethod
    def _wrong(kind: Any, value: object, name: str) -> Values:
        raise TypeError(f"{name} is a {type(value).__name__}, not {described(kind)}")


# --- and back ------------------------------------------------------------------------------------


class _Unpacker:
    def __init__(
        self, arrays: Mapping[str, Tensor], archives: Mapping[str, Archive], device: torch.device
    ) -> None:
        self._arrays = arrays
        self._archives = archives
        self._device = device
        self._pieces: dict[tuple[Any, ...], Archived] = {}
        """One reference per piece of an archive: its space is freed with that reference."""

    def value(self, kind: Any, value: Values, name: str) -> Any:
        """Return the value of a JSON form, given its kind."""
        made = self._made(plain(kind), value, name)
        if not holds(marks_of(kind), made):
            raise InputError(f"{name} has a value that cannot be")
        return made

    def _made(self, kind: Any, value: Values, name: str) -> Any:
        origin = get_origin(kind)
        if is_union(kind):
            return self._one_of(kind, value, name)
        if origin is Literal:
            return value if _is_in(value, get_args(kind)) else self._wrong(name)
        if is_record(kind):
            return self._record(kind, value, name)
        if is_array(kind):
            return self._array(kind, value, name)
        if origin in (list, tuple):
            items = self._of(list, value, name)
            kinds = item_kinds(kind, len(items))
            if len(kinds) != len(items):
                self._wrong(name)
            return origin(
                self.value(k, v, joined(name, n))
                for n, (k, v) in enumerate(zip(kinds, items, strict=True))
            )
        if origin is dict:
            return self._mapping(kind, value, name)
        if kind is Archive:
            return self._archive(value, name)
        if kind is Archived:
            return self._piece(value, name)
        if issubclass(kind, Enum):
            return kind[value] if _is_in(value, kind.__members__) else self._wrong(name)
        if kind is Path:
            return Path(self._of(str, value, name))
        if kind is float and type(value) is int:
            return float(value)
        return self._of(kind, value, name)

    def _one_of(self, kind: Any, value: Values, name: str) -> Any:
        kinds = alternatives(kind)
        if value is None and type(None) in get_args(kind):
            return None
        if len(kinds) == 1:
            return self.value(kinds[0], value, name)
        number, form = self._pair(value, name)
        if type(number) is not int or not 0 <= number < len(kinds):
            self._wrong(name)
        return self.value(kinds[number], form, name)

    def _record(self, kind: Any, value: Values, name: str) -> Any:
        own = stored(kind)
        given = self._of(dict, value, name)
        if given.keys() != own.keys():
            self._wrong(name)
        parts = {n: self.value(k, given[n], joined(name, n)) for n, k in own.items()}
        known: dict[str, int] = {}
        for n, k in own.items():
            if any(known.setdefault(x, m) != m for x, m in lengths(k, parts[n])):
                self._wrong(joined(name, n))
        try:
            return kind(**parts)
        except (TypeError, ValueError, ArithmeticError) as error:
            raise InputError(f"{name} holds what it cannot ({error})") from error

    def _mapping(self, kind: Any, value: Values, name: str) -> dict[Any, Any]:
        key, item = get_args(kind)
        pairs = [self._pair(p, name) for p in self._of(list, value, name)]
        made = {
            self.value(key, k, name): self.value(item, v, joined(name, n))
            for n, (k, v) in enumerate(pairs)
        }
        return made if len(made) == len(pairs) else self._wrong(name)

    def _array(self, kind: Any, place: Values, name: str) -> Tensor | np.ndarray:
        if name not in self._arrays or not _is_in(place, ("host", "device")):
            self._wrong(name)
        # In memory aligned by PyTorch: some libraries choose the order of additions by the
        # alignment, which in a file is arbitrary.
        made: Any = self._arrays[name].clone()
        if issubclass(kind.array_type, Tensor):
            made = made.to(self._device) if place == "device" else made
        else:
            made = made.numpy()
        return made if isinstance(made, kind) else self._wrong(name)

    def _archive(self, value: Values, name: str) -> Archive:
        return self._archives[value] if _is_in(value, self._archives) else self._wrong(name)

    def _piece(self, value: Values, name: str) -> Archived:
        given = self._of(dict, value, name)
        if given.keys() != {"archive", "offset", "shape", "dtype", "checksum"}:
            self._wrong(name)
        archive = self._archive(given["archive"], name)
        offset, checksum = (self._of(int, given[k], name) for k in ("offset", "checksum"))
        shape = tuple(self._of(int, n, name) for n in self._of(list, given["shape"], name))
        if not _is_in(given["dtype"], _DTYPES):
            self._wrong(name)
        key = archive.name, offset, shape, given["dtype"]
        piece = self._pieces.get(key)
        if piece is None:
            piece = archive.piece(offset, shape, np.dtype(given["dtype"]), checksum)
            self._pieces[key] = piece
        return piece if piece.checksum == checksum else self._wrong(name)

    def _pair(self, value: Values, name: str) -> list[Values]:
        pair = self._of(list, value, name)
        return pair if len(pair) == 2 else self._wrong(name)

    def _of(self, kind: type, value: Values, name: str) -> Any:
        return value if type(value) is kind else self._wrong(name)

    @staticmethod
    def _wrong(name: str) -> Any:
        raise InputError(f"{name or 'it'} is missing, or not what it should be")


def _is_in(value: Values, several: Any) -> bool:
    """Whether a form, which may be unhashable, is one of several plain values."""
    return isinstance(value, _PLAIN) and value in several
