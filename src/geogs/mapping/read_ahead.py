"""Views that threads bring back into memory before they are asked for."""

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import torch

from geogs.mapping.stored_maps import StoredMaps, ViewMaps
from geogs.threads import worker_count

THREADS = 4
"""Most threads; a view is mostly waiting for a disk, or for a GPU."""


@dataclass(frozen=True, eq=False)
class _Reading:
    """A view that is being read, and what it was made from when that began."""

    maps: Future[ViewMaps]
    basis: tuple[object, ...]


class ReadAhead:
    """Reads views in threads; who takes one gets what reading it now would give.

    What the views' owner changes meanwhile makes what was read worthless, and it is read again.
    """

    def __init__(self, load: Callable[[StoredMaps], ViewMaps]) -> None:
        """``load`` brings a view back; it is called by several threads at once."""
        self._load = load
        self._readings: dict[int, _Reading] = {}
        self._threads: ThreadPoolExecutor | None = None

    def begin(self, views: Sequence[StoredMaps]) -> None:
        """Begin to read some views; of those that were read before and are not among them, nothing
        is kept."""
        before, self._readings = self._readings, {}
        stream = None
        if views and views[0].keyframe.grid.on_gpu:
            stream = torch.cuda.current_stream()
        for stored in views:
            id = stored.keyframe.id
            known = before.pop(id, None)
            if known is None:
                known = _Reading(self._pool().submit(self._read, stored, stream), _basis(stored))
            self._readings[id] = known
        for left in before.values():
            left.maps.cancel()

    def take(self, stored: StoredMaps) -> ViewMaps | None:
        """A view that was read, or soon will be; None if it was not, or has changed since."""
        reading = self._readings.pop(stored.keyframe.id, None)
        if reading is None:
            return None
        now = _basis(stored)
        if any(a is not b for a, b in zip(reading.basis, now, strict=True)):
            return None
        return reading.maps.result()

    def _pool(self) -> ThreadPoolExecutor:
        if self._threads is None:
            self._threads = ThreadPoolExecutor(
                min(THREADS, worker_count()), thread_name_prefix="views",
                initializer=torch.set_num_threads, initargs=(1,),
            )  # fmt: skip
        return self._threads

    def _read(self, stored: StoredMaps, stream: "torch.cuda.Stream | None") -> ViewMaps:
        with torch.cuda.stream(stream):  # in whose order it is used
            return self._load(stored)


def _basis(stored: StoredMaps) -> tuple[object, ...]:
    """All that is ever replaced of what a view is made from."""
    keyframe = stored.keyframe
    return keyframe, stored.mask, stored.depth, stored.rendered_depth, stored.light, keyframe.scale
