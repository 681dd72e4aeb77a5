"""Poses of all keyframes of a run, one by one and as rows of one array.

Searches over all keyframes, for those near one, read the array, which is much faster than a loop
over keyframes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Float64, Int, Int64
from torch import Tensor

from geogs.limits import Id, Pose
from geogs.world.arrays import NOT_STORED


@dataclass(eq=False)
class PoseTable:
    """World-to-camera poses by keyframe id, float64, on the CPU.

    A pose is replaced, never changed in place: old references keep their old value.
    """

    T_cw: dict[Id, Pose] = field(default_factory=dict)
    _rows: Float64[np.ndarray, "c 4 4"] = field(init=False, repr=False, metadata=NOT_STORED)
    """The same as rows by id, with spare rows."""
    _centres: Float64[np.ndarray, "c 3"] = field(init=False, repr=False, metadata=NOT_STORED)

    def __post_init__(self) -> None:
        self._rows, self._centres = np.zeros((0, 4, 4)), np.zeros((0, 3))
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
