"""One table of all that is as large as an image: by name and keyframe, on disk and in memory."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from geogs.world.archive import Archive, Archived
from geogs.world.lru import LruCache

V = TypeVar("V")

NOT_STORED = {"stored": False}
"""Metadata of a field that belongs to the process and is left out of checkpoints."""
RESIDENT = 128
"""Keyframes whose large arrays stay in memory, where nobody says otherwise."""


@dataclass(eq=False)
class ArrayTable:
    """Large arrays by name and keyframe id; the file has all, the memory those used last.

    Arrays that are put are written at once; those put as ``recent`` stay in memory as well, until
    so many others of the name have been used since. What can be made again is kept beside them and
    never written. For any thread.
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
        """An array as it was put, not to be changed; None without. It stays in memory if recent."""
        piece = self.pieces.get(name, {}).get(id)
        if piece is None or not recent:
            return None if piece is None else piece.load()
        array: np.ndarray = self.recent(name).get(id, piece.load)
        return array

    def load(self, name: str, id: int) -> np.ndarray:
        """An array that there must be, as it was put."""
        return self.pieces[name][id].load()

    def made(self, name: str, id: int, make: Callable[[], V]) -> V:
        """A value that can be made again, and is where it is not among those used last."""
        value: V = self.recent(name).get(id, make)
        return value

    def drop(self, name: str, id: int) -> None:
        """Forget an array, if there is one."""
        self.pieces.get(name, {}).pop(id, None)
        if name in self._recent:
            self._recent[name].drop(id)

    def forget(self, id: int) -> None:
        """Forget all that there is of a keyframe."""
        for name in {*self.pieces, *self._recent}:
            self.drop(name, id)

    def recent(self, name: str, limit: int | None = None) -> LruCache[int, Any]:
        """Values of a name in memory; as many as are resident, or another ``limit``."""
        return self._recent.setdefault(name, LruCache(limit or self.resident))
