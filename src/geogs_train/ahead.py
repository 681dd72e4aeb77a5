"""Plans of the next training steps, drawn by other processes while the GPU works."""

import multiprocessing
import os
import pickle
from collections import deque
from concurrent.futures import Future, ProcessPoolExecutor
from functools import partial

import torch

from geogs_synth.clips.room_options import RoomOptions
from geogs_synth.clips.sampler import Plan, RoomSampler, draw_plan
from geogs_train.course import Worker

MOST_PROCESSES = 6
AHEAD = 8
"""Number of finished plans, besides those that are being drawn."""


class PlansAhead:
    """Draws the plans of consecutive steps ahead, as one takes longer than a step on a GPU."""

    def __init__(self, rooms: RoomSampler, batch: int, worker: Worker, least: int = 1) -> None:
        """For a GPU, ``least`` or more processes draw ahead; on a CPU plans are drawn on demand."""
        self._on_demand = partial(rooms.plan, batch=batch, rank=worker.rank)
        self._pool: ProcessPoolExecutor | None = None
        if worker.device.type == "cuda":
            cores = len(os.sched_getaffinity(0)) // worker.count
            processes = max(least, min(MOST_PROCESSES, (cores - 2) // 2))
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(processes, context)
            self._ahead = AHEAD + processes
        drawn = rooms.options, rooms.bank.materials, rooms.seed, batch, worker.rank
        self._draw = partial(_pickled_plan, *drawn)
        self._waiting: deque[tuple[int, Future[bytes]]] = deque()

    def plan(self, step: int) -> Plan:
        """Return the plan of a step, and start to draw those of the next steps."""
        if self._pool is None:
            return self._on_demand(step)
        while self._waiting and self._waiting[0][0] != step:
            self._waiting.popleft()[1].cancel()
        first = self._waiting[-1][0] + 1 if self._waiting else step
        for following in range(first, step + self._ahead):
            self._waiting.append((following, self._pool.submit(self._draw, following)))
        plan: Plan = pickle.loads(self._waiting.popleft()[1].result())
        return plan

    def rest(self) -> None:
        """Discard the plans drawn ahead; none are drawn until the next call of ``plan``."""
        while self._waiting:
            self._waiting.popleft()[1].cancel()

    def close(self) -> None:
        """End the processes."""
        if self._pool is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)


def _pickled_plan(
    options: RoomOptions, materials: int, seed: int, batch: int, rank: int, step: int
) -> bytes:
    torch.set_num_threads(1)
    # As bytes, so that no tensor is passed through shared memory, which containers lack.
    return pickle.dumps(draw_plan(options, materials, seed, step, batch, rank))
