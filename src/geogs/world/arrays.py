"""Arrays of all keyframes of a run: their poses as one array, image-sized arrays in a file."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float, Float64, Int, Int64
from torch import Tensor

from geogs.limits import Id, Pose
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
        if piece is None:
            return None
        return self.made(name, id, piece.load) if recent else piece.load()

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


@dataclass(eq=False)
class PoseTable:
    """World-to-camera poses by keyframe id, float64, on the CPU.

    Searches over all keyframes read the array, which is much faster than a loop over keyframes. A
    pose is replaced, never changed in place: old references keep their old value.
    """

    T_cw: dict[Id, Pose] = field(default_factory=dict)
    _rows: Float64[np.ndarray, "c 4 4"] = field(init=False, repr=False, metadata=NOT_STORED)
    """The same as rows by id, with spare rows."""
    _centres: Float64[np.ndarray, "c 3"] = field(init=False, repr=False, metadata=NOT_STORED)

    def __post_init__(self) -> None:
        self._rows = np.zeros((0, 4, 4))
        self._centres = np.zeros((0, 3))
        for id, T_cw in self.T_cw.items():
            self[id] = T_cw

    def __getitem__(self, id: int) -> Float[Tensor, "4 4"]:
        return self.T_cw[id]

    def __setitem__(self, id: int, T_cw: Float[Tensor, "4 4"]) -> None:
        if id >= len(self._rows):
            self._grow(id + 1)
        self.T_cw[id] = T_cw
        self._rows[id] = T = T_cw.numpy()
        self._centres[id] = -T[:3, :3].T @ T[:3, 3]

    def rows(self, ids: Sequence[int] | Int[np.ndarray, "n"]) -> Float64[np.ndarray, "n 4 4"]:
        """Copy the poses of some keyframes."""
        return self._rows[np.asarray(ids, np.int64)]

    def centres(self, ids: Sequence[int] | Int[np.ndarray, "n"]) -> Float64[np.ndarray, "n 3"]:
        """Copy the camera centres of some keyframes, in the world."""
        return self._centres[np.asarray(ids, np.int64)]

    def nearest(self, id: int, ids: Int64[np.ndarray, "n"], count: int) -> Int64[np.ndarray, "m"]:
        """Return the ``count`` keyframes among ``ids`` whose cameras are nearest to one's, nearest
        first; ties go to the first."""
        distance = np.linalg.norm(self.centres(ids) - self._centres[id], axis=1)
        if count < len(ids):
            # Includes all that are as near as the last, so that ties go to the first.
            limit = np.partition(distance, count - 1)[count - 1]
            within = np.flatnonzero(distance <= limit)
        else:
            within = np.arange(len(ids))
        return ids[within[np.argsort(distance[within], kind="stable")[:count]]]

    def around(
        self, id: int, ids: Int64[np.ndarray, "n"], angle: float, distance: float
    ) -> Int64[np.ndarray, "m"]:
        """Return the keyframes among ``ids`` less than ``distance`` from one's camera and rotated
        by less than ``angle`` degrees; nearest first."""
        away = np.linalg.norm(self.centres(ids) - self._centres[id], axis=1)
        within = np.flatnonzero(away < distance)
        within = within[np.argsort(away[within], kind="stable")]
        rotation = rotation_angles(self._rows[id], self.rows(ids[within]))
        return ids[within[rotation < angle]]

    def _grow(self, least: int) -> None:
        more = max(least, 2 * len(self._rows), 64) - len(self._rows)
        self._rows = np.concatenate([self._rows, np.zeros((more, 4, 4))])
        self._centres = np.concatenate([self._centres, np.zeros((more, 3))])


def rotation_angles(
    T: Float64[np.ndarray, "4 4"], others: Float64[np.ndarray, "n 4 4"]
) -> Float64[np.ndarray, "n"]:
    """Return the rotation angles in degrees between a pose and others."""
    relative = np.einsum("ik,njk->nij", T[:3, :3], others[:, :3, :3])
    axis = relative[:, [2, 0, 1], [1, 2, 0]] - relative[:, [1, 2, 0], [2, 0, 1]]
    cosine = np.trace(relative, axis1=1, axis2=2) - 1
    return np.degrees(np.arctan2(np.linalg.norm(axis, axis=1), cosine))
