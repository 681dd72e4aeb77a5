"""An image set as its format describes it: files, poses, cameras, points."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from geogs.errors import InputError
from geogs.io.pose_files import is_rigid, says_pose
from geogs.io.sources.account import Account
from geogs.io.sources.calibration import Calibration


@dataclass(frozen=True, slots=True)
class PosedFile:
    """An image on disk with its pose and, where known, its camera and mask."""

    path: Path
    T_cw: Float64[np.ndarray, "4 4"]
    """World to camera, OpenCV axes."""
    calibration: Calibration | None = None
    """Its camera; none where the format does not give it."""
    mask: Path | None = None
    """Mask image, bright where valid; may be ``path`` itself, then its alpha."""
    timestamp: float = 0.0
    """Seconds."""


@dataclass(frozen=True, slots=True)
class SparsePoints:
    """Triangulated points and the images that see them."""

    positions: Float64[np.ndarray, "n 3"]
    """In the world."""
    seen_point: Int64[np.ndarray, "m"]
    """Point of observation k."""
    seen_image: Int64[np.ndarray, "m"]
    """Image of observation k: its index in the source."""

    def for_images(self, kept: Sequence[int]) -> "SparsePoints":
        """The points seen by the images ``kept``, which are renumbered 0, 1, ..."""
        new_image = renumbered(self.seen_image, kept)
        stays = new_image >= 0
        points, seen_point = np.unique(self.seen_point[stays], return_inverse=True)
        return SparsePoints(self.positions[points], seen_point.astype(np.int64), new_image[stays])


def renumbered(numbers: Int64[np.ndarray, "m"], kept: Sequence[int]) -> Int64[np.ndarray, "m"]:
    """Index of each number in ``kept``, whose entries are distinct; -1 where it is missing."""
    order = np.argsort(kept, kind="stable")
    ascending = np.asarray(kept, dtype=np.int64)[order]
    place = np.searchsorted(ascending, numbers).clip(max=len(ascending) - 1)
    return np.where(ascending[place] == numbers, order[place], -1).astype(np.int64)


@dataclass(frozen=True, slots=True)
class PosedSet:
    """An image set as its format describes it."""

    kind: str
    """Name of the format."""
    name: str
    """Name of the scene."""
    files: tuple[PosedFile, ...]
    scene_scale: str = "arbitrary"
    """Unit of the world: metres, millimetres or arbitrary."""
    points: SparsePoints | None = None
    left_out: tuple[tuple[str, str], ...] = ()
    """Names of images that have no pose, each with the reason as a clause."""
    account: Account = field(default_factory=Account)
    """Findings of the reader beside the images."""

    def left(self, sentence: str) -> "PosedSet":
        """The set with one more sentence on what is not used."""
        return replace(self, account=self.account + Account(left=(sentence,)))

    def only(self, kept: Sequence[int]) -> "PosedSet":
        """The set reduced to the images ``kept``, in this order."""
        points = None if self.points is None else self.points.for_images(kept)
        return replace(self, files=tuple(self.files[i] for i in kept), points=points)


def without_invalid_poses(posed: PosedSet) -> PosedSet:
    """Drop images whose pose is NaN, inf or no rigid motion; the others become exactly rigid.

    Raises:
        InputError: no pose is left, or they are mirrored or scaled altogether.
    """
    T = np.stack([file.T_cw for file in posed.files])
    valid = is_rigid(T)
    has_pose = says_pose(T)
    if valid.sum() < 0.5 * has_pose.sum():
        _refuse(posed, T[has_pose, :3, :3])
    if not valid.any():
        raise InputError(f"{posed.name} holds no valid pose: all {len(T)} are NaN, inf or zero.")
    if not valid.all():
        count = f"{int((~valid).sum())} of {len(valid)} images"
        posed = posed.left(f"{count}, whose poses are invalid (NaN, inf or no rotation)")
    posed = posed.only(np.flatnonzero(valid).tolist())
    return replace(
        posed, files=tuple(replace(file, T_cw=_rigid(file.T_cw)) for file in posed.files)
    )


def _refuse(posed: PosedSet, rotation: Float64[np.ndarray, "n 3 3"]) -> None:
    if np.median(np.linalg.det(rotation)) < 0:
        raise InputError(
            f"{posed.name}: the poses mirror the scene (determinant -1), as when two axes are "
            f"swapped without turning a sign; negate one of the swapped axes."
        )
    raise InputError(
        f"{posed.name}: the poses are no rigid motions; scale the translations only, give each "
        f"matrix row by row, and 0 0 0 1 as its last row."
    )


def _rigid(T: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "4 4"]:
    """The pose with the nearest rotation; unchanged if its rotation is exact to 1e-9."""
    rotation = T[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-9:
        return T
    u, _, vt = np.linalg.svd(rotation)
    rigid = T.copy()
    rigid[:3, :3] = u @ vt
    return rigid
