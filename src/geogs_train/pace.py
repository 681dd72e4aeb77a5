"""How much of a run is done by the clock, the same for all that train together."""

import time

import torch
from torch import distributed

from geogs_train.course import Worker

EVERY = 10
"""Steps between looks at the clock; each waits for the device."""


class Clock:
    """Fraction of a run of some minutes that is done; from where it was when it began."""

    def __init__(self, minutes: float, begun: float, worker: Worker) -> None:
        self._seconds, self._begun, self._worker = 60 * minutes, begun, worker
        self._start = time.monotonic()

    def progress(self) -> float:
        """0 to 1, by the clock of the first worker."""
        done = min((time.monotonic() - self._start) / self._seconds, 1.0)
        return shared(self._begun + (1 - self._begun) * done, self._worker)


def shared(value: float, worker: Worker) -> float:
    """The first worker's value, for all; they wait for each other."""
    if worker.count == 1:
        return value
    first = torch.tensor([value], dtype=torch.float64, device=worker.device)
    distributed.broadcast(first, 0)
    return float(first.item())
