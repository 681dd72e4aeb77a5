"""What threads bring back into memory before it is asked for."""

from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

import torch

from geogs.threads import worker_count

V = TypeVar("V")

THREADS = 4
"""Most threads; one is mostly waiting for a disk, or for a GPU."""
Basis = tuple[object, ...]
"""All that is ever replaced of what a value is made from."""


class ReadAhead(Generic[V]):
    """Reads values by id in threads; who takes one gets what reading it now would give.

    What its owner changes meanwhile makes what was read worthless, and it is read again.
    """

    def __init__(
        self, load: Callable[[int], V], basis: Callable[[int], Basis], device: torch.device
    ) -> None:
        """``load`` brings a value back; it is called by several threads at once. Of a GPU it is
        called in the stream in which its values are used."""
        self._load = load
        self._basis = basis
        self._device = device
        self._readings: dict[int, tuple[Future[V], Basis]] = {}
        self._threads: ThreadPoolExecutor | None = None

    def begin(self, ids: Iterable[int]) -> None:
        """Begin to read some values; of those that were read before and are not among them, nothing
        is kept."""
        before, self._readings = self._readings, {}
        stream = torch.cuda.current_stream() if self._device.type == "cuda" else None
        for id in ids:
            known = before.pop(id, None)
            if known is None:
                known = self._pool().submit(self._read, id, stream), self._basis(id)
            self._readings[id] = known
        for left, _ in before.values():
            left.cancel()

    def take(self, id: int) -> V | None:
        """A value that was read, or soon will be; None if it was not, or has changed since."""
        reading = self._readings.pop(id, None)
        if reading is None:
            return None
        value, basis = reading
        if any(a is not b for a, b in zip(basis, self._basis(id), strict=True)):
            return None
        return value.result()

    def _pool(self) -> ThreadPoolExecutor:
        if self._threads is None:
            self._threads = ThreadPoolExecutor(
                min(THREADS, worker_count()), thread_name_prefix="views",
                initializer=torch.set_num_threads, initargs=(1,),
            )  # fmt: skip
        return self._threads

    def _read(self, id: int, stream: "torch.cuda.Stream | None") -> V:
        with torch.cuda.stream(stream):
            return self._load(id)
