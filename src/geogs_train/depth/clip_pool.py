"""Pool of clips of random rooms on the device: more keyframes a second than can be rendered."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Float16, UInt8
from torch import Tensor

from geogs_synth.clips.clip_batch import ClipBatch
from geogs_synth.clips.sampler import RoomSampler
from geogs_synth.scene.batch import map_tensors
from geogs_train.ahead import PlansAhead
from geogs_train.course import Worker

QUANTILES = (0.05, 0.5, 0.95)
"""Quantiles of depth, used as a tracker's knowledge of a view."""


@dataclass(frozen=True)
class StoredClips:
    """n stored clips of v views."""

    images: UInt8[Tensor, "n v 3 h w"]
    depth: Float[Tensor, "n v h w"]
    """Metres."""
    normal: Float16[Tensor, "n v 3 h w"]
    """Camera frame."""
    T_cw: Float[Tensor, "n v 4 4"]
    intrinsics: Float[Tensor, "n 4"]
    quantiles: Float[Tensor, "n v 3"]
    """Quantiles of depth, metres."""

    @staticmethod
    def of(clips: ClipBatch) -> "StoredClips":
        """Convert a batch of clips."""
        coarse = clips.depth[..., ::4, ::4].flatten(2)
        levels = torch.tensor(QUANTILES, device=coarse.device)
        return StoredClips(
            (clips.images * 255).round().to(torch.uint8),
            clips.depth,
            clips.normal.half(),
            clips.views.T_cw,
            clips.views.intrinsics,
            coarse.quantile(levels, -1).movedim(0, -1),
        )


class ClipPool:
    """Pool that holds at turn t the batches t to t + ``plans`` - 1 of an endless supply."""

    def __init__(self, rooms: RoomSampler, plans: int, clips: int, worker: Worker) -> None:
        """``clips`` is the number of clips in a batch."""
        self._rooms = rooms
        self._plans = plans
        self._clips = clips
        self._ahead = PlansAhead(rooms, clips, worker)
        self._stored: StoredClips | None = None
        self._turn = 0

    def at(self, turn: int) -> StoredClips:
        """The clips of a turn; missing batches are rendered and replace the oldest."""
        first = self._turn + self._plans
        if self._stored is None or not self._turn <= turn <= first:
            first = turn
        for number in range(first, turn + self._plans):
            self._put(number, StoredClips.of(self._rooms.film(self._ahead.plan(number))))
        self._turn = turn
        assert self._stored is not None
        return self._stored

    def empty(self) -> None:
        """Free the stored clips, and draw nothing ahead until the next call of ``at``."""
        self._stored = None
        self._ahead.rest()

    def close(self) -> None:
        """End the processes."""
        self._ahead.close()

    def _put(self, number: int, clips: StoredClips) -> None:
        if self._stored is None:
            shape = (self._plans * self._clips,)
            self._stored = map_tensors(lambda x: x.new_empty(shape + x.shape[1:]), clips)
        start = number % self._plans * self._clips
        for kept, new in zip(vars(self._stored).values(), vars(clips).values(), strict=True):
            kept[start : start + self._clips] = new
