"""Numeric arrays of MATLAB files, version 5 (and 7, which compresses them).

A reader of our own, since that of SciPy can be made to crash by a file. After "MAT-File Format",
The MathWorks, 2019.
"""

import math
import struct
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geogs.errors import InputError
from geogs.guard.documents import read_bytes

LARGEST_ARRAY = 1 << 30
"""Largest size of an unpacked array in bytes; those of DTU have 60 MB."""
_HEADER, _TAG, _HEAD = 128, 8, 1024
_MATRIX, _COMPRESSED = 14, 15
_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8",
           13: "u8"}  # fmt: skip
"""Types of stored values, by their numbers in the file."""
_CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8",
            15: "u8"}  # fmt: skip
"""Types of arrays, which may be stored as smaller ones."""
_COMPLEX = 0x0800


def read_mat(path: Path, names: Collection[str]) -> dict[str, np.ndarray]:
    """Read the real arrays of these names; missing ones are left out.

    Raises:
        InputError: the file is missing, too large, damaged, or none of MATLAB's version 5 or 7.
    """
    data = read_bytes(path, LARGEST_ARRAY)
    try:
        return dict(_arrays(data, names))
    except (ValueError, struct.error, zlib.error):
        said = f"{path} is damaged or no MATLAB file of version 5 or 7; copy it again."
        raise InputError(said) from None


@dataclass(frozen=True)
class _Element:
    """A piece of a file with its type; ``data`` may be cut off where not all was unpacked."""

    type: int
    size: int
    data: memoryview
    end: int
    """Offset of the next element."""

    def whole(self) -> memoryview:
        if len(self.data) < self.size:
            raise ValueError("cut off")
        return self.data


def _arrays(data: bytes, names: Collection[str]) -> Iterator[tuple[str, np.ndarray]]:
    order = {b"IM": "<", b"MI": ">"}.get(data[126:_HEADER])
    if order is None or struct.unpack(f"{order}H", data[124:126])[0] != 0x0100:
        raise ValueError("another version")
    rest = memoryview(data)[_HEADER:]
    while len(rest):
        element = _element(rest, order)
        is_packed = element.type == _COMPRESSED
        matrix = _element(_unpacked(element.whole(), _HEAD), order) if is_packed else element
        if matrix.type == _MATRIX:
            head = _Head.of(matrix.data, order)
            if head.name in names:
                if is_packed:
                    if matrix.size > LARGEST_ARRAY:
                        raise ValueError("too large")
                    matrix = _element(_unpacked(element.whole(), _TAG + matrix.size), order)
                yield head.name, head.array(matrix.whole(), order)
        # Compressed elements are not padded to a multiple of eight bytes.
        rest = rest[_TAG + element.size if is_packed else element.end :]


@dataclass(frozen=True)
class _Head:
    """Header of an array."""

    flags: int
    shape: tuple[int, ...]
    name: str
    end: int

    @staticmethod
    def of(data: memoryview, order: str) -> "_Head":
        flags = _element(data, order)
        shape = _element(data[flags.end :], order)
        name = _element(data[flags.end + shape.end :], order)
        sizes = np.frombuffer(shape.whole(), f"{order}i4").tolist()
        if min(sizes, default=-1) < 0:
            raise ValueError("no shape")
        word = struct.unpack_from(f"{order}I", flags.whole())[0]
        text = bytes(name.whole()).decode("latin1")
        return _Head(word, tuple(sizes), text, flags.end + shape.end + name.end)

    def array(self, data: memoryview, order: str) -> np.ndarray:
        """The numbers, in the type of the array."""
        type = _CLASSES.get(self.flags & 0xFF)
        values = _element(data[self.end :], order)
        stored = _STORED.get(values.type)
        if type is None or stored is None or self.flags & _COMPLEX:
            raise ValueError("no real numbers")
        found = np.frombuffer(values.whole(), f"{order}{stored}")
        if found.size != math.prod(self.shape):
            raise ValueError("of another size")
        return found.astype(type).reshape(self.shape, order="F")


def _element(data: memoryview, order: str) -> _Element:
    type, size = struct.unpack_from(f"{order}II", data)
    if type >> 16:  # a small one, with its data in its tag
        if type >> 16 > 4:
            raise ValueError("no small element")
        return _Element(type & 0xFFFF, type >> 16, data[4 : 4 + (type >> 16)], _TAG)
    end = _TAG + size
    return _Element(type, size, data[_TAG:end], end + -end % 8)


def _unpacked(data: memoryview, size: int) -> memoryview:
    """The first ``size`` bytes of compressed data."""
    return memoryview(zlib.decompressobj().decompress(data, size))
