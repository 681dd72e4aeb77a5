"""Consistency checks of the tables of a record that was read: lengths and references."""

from collections.abc import Container, Mapping
from typing import Any

import numpy as np
from torch import Tensor

from geogs.errors import InputError
from geogs.limits import Reference, holds
from geogs.world.archive import Archived
from geogs.world.arrays import ArrayTable
from geogs.world.kinds import is_array, lengths, marks_of, parts, plain

Tables = Mapping[str, Container[object]]
"""Existing rows, by the name of their table."""
Sizes = Mapping[str, int]
"""Sizes by the letters in the shapes of arrays."""


def check_tables(kind: Any, record: object, sizes: Sizes, tables: Tables) -> None:
    """Raise InputError where an array of a record disagrees with ``sizes``, or a reference names no
    row of its table. Other sizes and tables are not checked."""
    for part in parts(kind, record):
        if is_array(part.kind) and _has_other(sizes, part.kind, part.value):
            raise InputError(f"{part.place} is of another camera")
        for mark in part.marks:
            if isinstance(mark, Reference) and mark.table in tables:
                rows = tables[mark.table]
                named = part.value
                several = named.tolist() if isinstance(named, Tensor | np.ndarray) else [named]
                if not all(row in rows for row in set(several)):
                    raise InputError(f"{part.place} names what is missing in the {mark.table}")


def check_arrays(
    table: ArrayTable, kinds: Mapping[str, Any], sizes: Sizes, ids: Container[object]
) -> None:
    """Raise InputError where a large array is not an allowed one.

    ``kinds``: allowed kinds by array name, such as ``Float32[np.ndarray, "h w"]``; ``ids``:
    keyframes that may have arrays. Arrays of floats are read to check their values.
    """
    for name, pieces in table.pieces.items():
        for id, piece in pieces.items():
            if name not in kinds or id not in ids or not _is_of(kinds[name], piece, sizes):
                raise InputError(f"the {name[:40]!r} of keyframe {id} cannot be")


def _is_of(kind: Any, piece: Archived, sizes: Sizes) -> bool:
    bare = plain(kind)
    marks = marks_of(kind)
    # Types and shapes need no values: check a broadcast array that takes next to no memory.
    shape = np.broadcast_to(np.zeros((), piece.dtype), piece.shape)
    if not isinstance(shape, bare) or _has_other(sizes, bare, shape):
        return False
    return piece.dtype.kind != "f" or holds(marks, piece.load())


def _has_other(sizes: Sizes, kind: Any, array: Tensor | np.ndarray) -> bool:
    return any(sizes.get(x, m) != m for x, m in lengths(kind, array))
