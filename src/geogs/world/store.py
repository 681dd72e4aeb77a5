"""All keyframes of a run, by stable id: the one owner of their poses, depths and scales."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from geogs.errors import InputError
from geogs.geometry.lie import scaled, sim3_scale
from geogs.types import PoseCorrection
from geogs.world.archive import Archive
from geogs.world.grid import SampleGrid
from geogs.world.keyframe import Keyframe, KeyframeState
from geogs.world.pictures import Encode, Picture, Pictures
from geogs.world.poses import PoseTable

RESIDENT = 128
"""Keyframes whose large arrays stay in memory, where nobody says otherwise."""


@dataclass(frozen=True, eq=False)
class StoreState:
    """What a checkpoint holds of a store, but for the keyframes: their segments say them."""

    next_id: int
    images: Archive
    normals: Archive
    depths: Archive


class KeyframeStore:
    """The keyframes of a run, each in the segment of video that shares its world and unit.

    Who works with keyframes holds ids, or a segment, and asks here. Of the images, and of what
    others keep of a keyframe that is as large as an image, those of the ``resident`` keyframes used
    last are in memory.
    """

    def __init__(
        self, grid: SampleGrid, encode: Encode | None = None, resident: int = RESIDENT
    ) -> None:
        """``encode`` is the flow operator's; images are encoded again by it when needed."""
        self.grid = grid
        self.resident = resident
        self.pictures = Pictures(encode, resident)
        self.poses = PoseTable()
        self.next_id = 0
        """The id that the next keyframe gets; ids grow and are never used twice."""
        self._segment: dict[int, Segment] = {}

    def __getitem__(self, id: int) -> Keyframe:
        return self._segment[id][id]

    def __contains__(self, id: int) -> bool:
        return id in self._segment

    def segment_of(self, id: int) -> "Segment":
        """The segment that a keyframe is in at present. Raises KeyError if there is none."""
        return self._segment[id]

    def state(self) -> StoreState:
        """What a checkpoint holds."""
        pictures = self.pictures
        return StoreState(self.next_id, pictures.images, pictures.normals, pictures.depths)

    def load(self, state: StoreState) -> None:
        """Give a store without keyframes the state of another."""
        self.next_id = state.next_id
        self.pictures.images, self.pictures.normals = state.images, state.normals
        self.pictures.depths = state.depths

    def new_segment(self) -> "Segment":
        """A segment without keyframes, with a world of its own."""
        return Segment(self)

    def take_id(self, segment: "Segment") -> int:
        """A new id of a keyframe in a segment."""
        self._segment[self.next_id] = segment
        self.next_id += 1
        return self.next_id - 1

    def assign(self, ids: Sequence[int], segment: "Segment | None") -> None:
        """Let keyframes belong to a segment, or to none any more."""
        for id in ids:
            if segment is None:
                del self._segment[id]
            else:
                self._segment[id] = segment


class Segment:
    """Keyframes that share a world, in order of time, by id."""

    def __init__(self, store: KeyframeStore) -> None:
        self.store = store
        self.grid = store.grid
        self._keyframes: dict[int, Keyframe] = {}
        self._corrections: list[PoseCorrection] = []

    def __len__(self) -> int:
        return len(self._keyframes)

    def __iter__(self) -> Iterator[Keyframe]:
        return iter(self._keyframes.values())

    def __getitem__(self, id: int) -> Keyframe:
        return self._keyframes[id]

    def __contains__(self, id: int) -> bool:
        return id in self._keyframes

    @property
    def ids(self) -> list[int]:
        """All ids, earliest first."""
        return list(self._keyframes)

    def add(
        self,
        frame_index: int,
        timestamp: float,
        image: UInt8[np.ndarray, "h w 3"],
        encoded: Any,
        T_cw: Float[Tensor, "4 4"],
    ) -> Keyframe:
        """Append a keyframe with unit inverse depth and no information."""
        grid, id = self.grid, self.store.take_id(self)
        picture = self.store.pictures.add(image, encoded)
        ones = torch.ones(grid.size, device=grid.device)
        poses = self.store.poses
        poses[id] = T_cw
        keyframe = Keyframe(id, frame_index, timestamp, grid, picture, poses, ones, 0 * ones)
        self._keyframes[id] = keyframe
        return keyframe

    def put(self, keyframe: Keyframe) -> None:
        """Add a keyframe as it is, of another store, with the id that it has there.

        Its pose is to be in this store's table.
        """
        self._keyframes[keyframe.id] = keyframe
        self.store.assign([keyframe.id], self)

    def state(self) -> list[KeyframeState]:
        """What a checkpoint holds, once the corrections have been taken."""
        return [keyframe.state() for keyframe in self]

    def load(self, states: list[KeyframeState]) -> None:
        """Give a segment without keyframes those of another, whose store has been loaded.

        Raises:
            InputError: they are of another camera, or not in order.
        """
        grid, pictures = self.grid, self.store.pictures
        size = grid.camera.height, grid.camera.width, 3
        for s in states:
            cells = s.inverse_depth if s.moving is None else s.moving
            measured = cells if s.measured is None else s.measured.inverse_depth
            shapes = {s.inverse_depth.shape, cells.shape, measured.shape}
            if s.image.shape != size or shapes != {(grid.size,)}:
                raise InputError(f"keyframe {s.id} is of another camera")
            if s.id in self.store or not max(self._keyframes, default=-1) < s.id:
                raise InputError(f"keyframe {s.id} is not in its place")
            picture = Picture(pictures, s.image, s.normal, s.depth)
            self.store.poses[s.id] = s.T_cw
            self._keyframes[s.id] = Keyframe(
                s.id, s.frame_index, s.timestamp, grid, picture, self.store.poses, s.inverse_depth,
                s.information, s.prior, s.scale, s.moving, s.measured, s.pose,
            )  # fmt: skip
        self.store.assign(self.ids, self)

    def absorb(self, other: "Segment") -> None:
        """Take over the keyframes of another segment, which are in this one's world already."""
        self._keyframes = dict(sorted({**self._keyframes, **other._keyframes}.items()))
        self.store.assign(other.ids, self)
        other._keyframes = {}

    def remove(self, id: int) -> Keyframe:
        """Take a keyframe out and return it."""
        self.store.assign([id], None)
        return self._keyframes.pop(id)

    def poses(self, ids: Sequence[int]) -> Float[Tensor, "n 4 4"]:
        """World to camera, float64, on the CPU."""
        return torch.from_numpy(self.store.poses.rows(ids))

    def inverse_depths(self, ids: Sequence[int]) -> Float[Tensor, "n p"]:
        """On the grid."""
        return torch.stack([self._keyframes[i].inverse_depth for i in ids])

    def informations(self, ids: Sequence[int]) -> Float[Tensor, "n p"]:
        """On the grid, pixels^2 per inverse depth^2."""
        return torch.stack([self._keyframes[i].information for i in ids])

    def rescale(self, factor: float) -> None:
        """Multiply every length by ``factor``."""
        for keyframe in self:
            keyframe.T_cw = scaled(keyframe.T_cw, factor)
            keyframe.rescale(factor)

    def correct(self, correction: PoseCorrection) -> None:
        """Take over poses and scales of a loop closure or another global correction.

        Who keeps something in world coordinates is told of it by ``take_corrections``.
        """
        for id, T in correction.after.items():
            keyframe = self._keyframes[id]
            keyframe.T_cw = T.to(keyframe.T_cw)
            keyframe.rescale(1 / correction.scale.get(id, 1.0))
        self._corrections.append(correction)

    def take_corrections(self) -> list[PoseCorrection]:
        """Corrections made since the last call, earliest first."""
        taken, self._corrections = self._corrections, []
        return taken

    def moved(self, S: Float[Tensor, "4 4"]) -> PoseCorrection:
        """The correction that takes all to another world, given the Sim(3) from it to theirs."""
        scale = float(sim3_scale(S))
        before = {k.id: k.T_cw for k in self}
        after = {}
        for k, T in before.items():
            after[k] = T @ S.to(T)
            after[k][:3] /= scale
        return PoseCorrection(before, after, dict.fromkeys(before, scale))
