"""The keyframes a tracker holds, by stable id."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from geogs.keyframes.grid import SampleGrid
from geogs.keyframes.pictures import Picture, PictureArchive
from geogs.priors.base import DepthKind
from geogs.types import Keyframe

RELATIVE_FLOOR = 0.004
"""Relative depth deviation that no amount of matches removes."""


@dataclass
class KeyframePrior:
    """What a monocular prior said of a keyframe's depth, and how it is scaled; mutable."""

    kind: DepthKind
    values: Float[Tensor, "p"]
    """As the prior gave them, on the grid."""
    inverse_depth: Float[Tensor, "p"]
    """Aligned to the tracker's; 0 where unknown, and everywhere before the first alignment."""
    scale: Float[Tensor, "k"]
    """Factors of the aligned inverse depth at the nodes of a coarse grid, row by row."""
    information: Float[Tensor, "p"]
    """What it adds to the inverse variance of the keyframe's inverse depth."""
    is_aligned: bool = False

    def rescale(self, factor: float) -> None:
        """Multiply every length by ``factor``."""
        self.scale = self.scale / factor
        self.information = self.information * factor**2


@dataclass
class KeyframeState:
    """What the tracker estimates and remembers of one keyframe; mutable."""

    id: int
    frame_index: int
    timestamp: float
    picture: Picture
    """Image and normals, in memory or not."""
    T_cw: Float[Tensor, "4 4"]
    """float64, on the CPU whatever the device of the grid."""
    inverse_depth: Float[Tensor, "p"]
    information: Float[Tensor, "p"]
    """Of the matches alone."""
    prior: KeyframePrior | None = None

    def rescale(self, factor: float) -> None:
        """Multiply every length that the camera sees by ``factor``; the pose stays."""
        self.inverse_depth = self.inverse_depth / factor
        self.information = self.information * factor**2
        if self.prior is not None:
            self.prior.rescale(factor)

    @property
    def image(self) -> UInt8[np.ndarray, "h w 3"]:
        """RGB; not to be changed in place."""
        return self.picture.image

    @image.setter
    def image(self, image: UInt8[np.ndarray, "h w 3"]) -> None:
        self.picture.image = image

    @property
    def encoded(self) -> Any:
        """The flow operator's form of the image."""
        return self.picture.encoded

    @encoded.setter
    def encoded(self, encoded: Any) -> None:
        self.picture.encoded = encoded

    @property
    def normal(self) -> Float[Tensor, "h w 3"] | None:
        """A monocular prior's unit normals in the camera frame, facing the camera."""
        return self.picture.normal

    @normal.setter
    def normal(self, normal: Float[Tensor, "h w 3"] | None) -> None:
        self.picture.normal = normal


@dataclass
class KeyframeIds:
    """Gives out ids, which grow and are never used twice; several stores may share it."""

    next: int = 0

    def take(self) -> int:
        """A new id."""
        self.next += 1
        return self.next - 1


class KeyframeStore:
    """Keyframes in order of time, by id.

    Where ``encode``, the flow operator's, is given, only the ``resident`` keyframes used last have
    their images in memory; those of others are read from a file and encoded again when needed.
    """

    def __init__(
        self,
        grid: SampleGrid,
        encode: Callable[[UInt8[np.ndarray, "h w 3"]], Any] | None = None,
        resident: int = 64,
        ids: KeyframeIds | None = None,
    ) -> None:
        self.grid = grid
        self._numbers = ids or KeyframeIds()
        self._pictures = None if encode is None else PictureArchive(encode, resident)
        self._states: dict[int, KeyframeState] = {}
        self._reported: dict[int, tuple[Tensor, Tensor, Tensor]] = {}
        """Inverse depth and information of each keyframe as last exported, and its limit."""

    def __len__(self) -> int:
        return len(self._states)

    def __iter__(self) -> Iterator[KeyframeState]:
        return iter(self._states.values())

    def __getitem__(self, id: int) -> KeyframeState:
        return self._states[id]

    def __contains__(self, id: int) -> bool:
        return id in self._states

    @property
    def ids(self) -> list[int]:
        """All ids, earliest first."""
        return list(self._states)

    @property
    def next_id(self) -> int:
        """The id that the next keyframe gets."""
        return self._numbers.next

    def add(
        self,
        frame_index: int,
        timestamp: float,
        image: UInt8[np.ndarray, "h w 3"],
        encoded: Any,
        T_cw: Float[Tensor, "4 4"],
    ) -> KeyframeState:
        """Append a keyframe with unit inverse depth and no information."""
        ones = torch.ones(self.grid.size, device=self.grid.device)
        picture = Picture(image, encoded, self._pictures)
        id = self._numbers.take()
        self._states[id] = KeyframeState(id, frame_index, timestamp, picture, T_cw, ones, 0 * ones)
        return self._states[id]

    def absorb(self, other: "KeyframeStore") -> None:
        """Take over the keyframes of another store, whose ids are others."""
        self._states = dict(sorted({**self._states, **other._states}.items()))
        self._reported.update(other._reported)

    def remove(self, id: int) -> KeyframeState:
        """Take a keyframe out and return it."""
        self._reported.pop(id, None)
        return self._states.pop(id)

    def poses(self, ids: Sequence[int]) -> Float[Tensor, "n 4 4"]:
        """World to camera, float64, on the CPU."""
        return torch.stack([self._states[i].T_cw for i in ids])

    def inverse_depths(self, ids: Sequence[int]) -> Float[Tensor, "n p"]:
        """On the grid."""
        return torch.stack([self._states[i].inverse_depth for i in ids])

    def informations(self, ids: Sequence[int]) -> Float[Tensor, "n p"]:
        """On the grid, pixels^2 per inverse depth^2."""
        return torch.stack([self._states[i].information for i in ids])

    def rescale(self, factor: float) -> None:
        """Multiply every length by ``factor``."""
        for state in self:
            state.T_cw = scaled(state.T_cw, factor)
            state.rescale(factor)

    def export(self, id: int) -> Keyframe:
        """The keyframe as the rest of the system sees it; tensors are copies.

        Image and normals are references to the archive, where there is one. The pose is on the CPU,
        inverse depth and information are on the grid's device.
        """
        s = self._states[id]
        shape = (self.grid.height, self.grid.width)
        return Keyframe(
            id=s.id,
            frame_index=s.frame_index,
            timestamp=s.timestamp,
            stored_image=s.picture.stored_image,
            T_cw=s.T_cw.clone(),
            inverse_depth=s.inverse_depth.reshape(shape).clone(),
            information=self._limited(s).reshape(shape).clone(),
            stored_normal=s.picture.stored_normal,
        )

    def _limited(self, s: KeyframeState) -> Float[Tensor, "p"]:
        """Information less the error that no match removes; computed again after a change only.

        What a prior adds is only told of where depth has been adjusted with it.
        """
        depth, information, limited = self._reported.get(s.id, (None, None, s.information))
        if depth is not s.inverse_depth or information is not s.information:
            # What matches agree on is still wrong by a common error of poses and scale.
            floor = (RELATIVE_FLOOR * s.inverse_depth).square()
            known = s.information if s.prior is None else s.information + s.prior.information
            limited = known / (1 + known * floor)
            self._reported[s.id] = (s.inverse_depth, s.information, limited)
        return limited


def scaled(T: Float[Tensor, "*b 4 4"], factor: float) -> Float[Tensor, "*b 4 4"]:
    """The pose with its translation multiplied by ``factor``."""
    out = T.clone()
    out[..., :3, 3] *= factor
    return out
