"""Plans of the next training steps, drawn by other processes while the GPU works."""

import multiprocessing
import pickle
from collections import deque
from concurrent.futures import Future, ProcessPoolExecutor
from functools import partial

from geogs_synth.clips.room_options import RoomOptions
from geogs_synth.clips.sampler import Plan, draw_plan

PROCESSES = 3
AHEAD = 8
"""Plans that are ready, beside those that are being drawn."""


class PlansAhead:
    """The plans of consecutive steps; drawing one takes longer than a step may."""

    def __init__(
        self,
        options: RoomOptions,
        materials: int,
        seed: int,
        batch: int,
        rank: int,
        processes: int = PROCESSES,
    ) -> None:
        self._draw = partial(_pickled_plan, options, materials, seed, batch, rank)
        self._pool = ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"))
        self._ahead = AHEAD + processes
        self._waiting: deque[tuple[int, Future[bytes]]] = deque()

    def plan(self, step: int) -> Plan:
        """The plan of a step; those of the steps after it are begun."""
        while self._waiting and self._waiting[0][0] != step:
            self._waiting.popleft()[1].cancel()
        first = self._waiting[-1][0] + 1 if self._waiting else step
        for following in range(first, step + self._ahead):
            self._waiting.append((following, self._pool.submit(self._draw, following)))
        return pickle.loads(self._waiting.popleft()[1].result())

    def rest(self) -> None:
        """Draw nothing until a plan is asked for again."""
        while self._waiting:
            self._waiting.popleft()[1].cancel()

    def close(self) -> None:
        """End the processes."""
        self._pool.shutdown(wait=False, cancel_futures=True)


def _pickled_plan(
    options: RoomOptions, materials: int, seed: int, batch: int, rank: int, step: int
) -> bytes:
    import torch

    torch.set_num_threads(1)
    # As bytes, so that no tensor is handed over through shared memory, which containers lack.
    return pickle.dumps(draw_plan(options, materials, seed, step, batch, rank))
