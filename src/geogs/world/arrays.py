"""One table of all image-sized arrays, by name and keyframe, on disk and in memory."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from geogs.world.archive import Archive, Archived
from geogs.world.lru import LruCache

V = TypeVar("V")

NOT_STORED = {"stored": False}
"""Metadata of a field that is left out of checkpoints."""
RESIDENT = 128
"""Default number of keyframes whose large arrays stay in memory."""


@dataclass(eq=False)
class ArrayTable:
    """Large arrays by name and keyframe id: all in the file, those used last also in memory.

    Arrays are written at once; those put as ``recent`` also stay in memory until ``resident``
    others of that name have been used. Values that can be recomputed are cached with them and never
    written. Thread-safe.
    """

    archive: Archive = field(default_factory=Archive)
    pieces: dict[str, dict[int, Archived]] = field(default_factory=dict)
    resident: int = field(default=RESIDENT, metadata=NOT_STORED)
    """Values of a name that stay in memory."""
    _recent: dict[str, LruCache[int, Any]] = field(
        default_factory=dict, init=False, repr=False, metadata=NOT_STORED
    )

    def put(self, name: str, id: int, array: np.ndarray, recent: bool = False) -> None:
        """Write an array; one that stays in memory must not be changed.

        Raises OutputError if the disk is full, or cannot be written.
        """
        self.pieces.setdefault(name, {})[id] = self.archive.put(array)
        if recent:
            self.recent(name).put(id, array)

    def has(self, name: str, id: int) -> bool:
        """Whether there is an array."""
        return id in self.pieces.get(name, ())

    def get(self, name: str, id: int, recent: bool = False) -> np.ndarray | None:
        """Return an array, not to be changed, or None. It stays in memory if recent."""
        piece = self.pieces.get(name, {}).get(id)
        if piece is None or not recent:
            return None if piece is None else piece.load()
        array: np.ndarray = self.recent(name).get(id, piece.load)
        return array

    def load(self, name: str, id: int) -> np.ndarray:
        """Return an array that must exist."""
        return self.pieces[name][id].load()

    def made(self, name: str, id: int, make: Callable[[], V]) -> V:
        """Return a cached value, or compute it again."""
        value: V = self.recent(name).get(id, make)
        return value

    def drop(self, name: str, id: int) -> None:
        """Forget an array, if there is one."""
        self.pieces.get(name, {}).pop(id, None)
        if name in self._recent:
            self._recent[name].drop(id)

    def forget(self, id: int) -> None:
        """Forget all arrays of a keyframe."""
        for name in {*self.pieces, *self._recent}:
            self.drop(name, id)

    def recent(self, name: str, limit: int | None = None) -> LruCache[int, Any]:
        """Return the values of a name in memory, at most ``limit`` (default: ``resident``)."""
        return self._recent.setdefault(name, LruCache(limit or self.resident))
