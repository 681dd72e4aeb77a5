"""Values that threads read into memory before they are used."""

from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

import torch

from geogs.threads import worker_count

V = TypeVar("V")

THREADS = 4
"""Most threads; each mostly waits for a disk or a GPU."""
Basis = tuple[object, ...]
"""The replaceable objects that a value is made from."""


class ReadAhead(Generic[V]):
    """Reads values by id in threads; ``take`` returns what reading now would.

    Values whose ``Basis`` has changed since are discarded.
    """

    def __init__(
        self, load: Callable[[int], V], basis: Callable[[int], Basis], device: torch.device
    ) -> None:
        """``load`` reads a value; several threads call it, on a GPU in the stream of ``begin``."""
        self._load = load
        self._basis = basis
        self._device = device
        self._readings: dict[int, tuple[Future[V], Basis]] = {}
        self._threads: ThreadPoolExecutor | None = None

    def begin(self, ids: Iterable[int]) -> None:
        """Begin to read some values, and discard those of the last call that are not among them."""
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
        """A value that was or is being read; None if it was not, or its basis has changed since."""
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
