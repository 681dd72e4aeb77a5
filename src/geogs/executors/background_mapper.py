"""Mapping in a thread of its own, so that tracking never waits for it."""

import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.concurrent import PriorityGate
from geogs.errors import GeogsError
from geogs.mapping.mapper import Mapper, never_pause
from geogs.types import MapSnapshot, PoseCorrection
from geogs.world.keyframes import Keyframe, KeyframeTable

Handover = Sequence[tuple[Keyframe, Float[Tensor, "4 4"]]]
"""Copies of keyframes that have changed, and their poses."""


class KeyframeMirror:
    """A copy of a table that changes only by :meth:`update`.

    Fields of keyframes are replaced, never changed in place; so a copy of references is enough.
    """

    def __init__(self, keyframes: KeyframeTable) -> None:
        self._original = keyframes
        self.table = keyframes.mirror()
        """The copies, for the other thread."""
        self._copies = self.table.new_set()
        self._seen: dict[int, tuple[object, ...]] = {}
        """State of each followed keyframe at the last handover."""

    def follow(self, ids: Iterable[int]) -> None:
        """Also copy these keyframes from now on."""
        self._seen |= dict.fromkeys(ids, ())

    def changed(self) -> Handover:
        """Copy the keyframes that have changed since the last call."""
        changed = []
        for id, before in self._seen.items():
            keyframe = self._original[id]
            now = _parts(keyframe)
            if len(before) != len(now) or any(a is not b for a, b in zip(now, before, strict=True)):
                self._seen[id] = now
                changed.append((keyframe.copied_to(self.table), keyframe.T_cw))
        return changed

    def update(self, changed: Handover, stream: "torch.cuda.Stream | None") -> None:
        """Apply the changes, in the other thread, which works in a ``stream`` of a GPU."""
        for keyframe, T_cw in changed:
            keyframe.T_cw = T_cw
            if keyframe.id in self._copies:
                vars(self._copies[keyframe.id]).update(vars(keyframe))
            else:
                self._copies.put(keyframe)
            for value in vars(keyframe).values():
                if stream is not None and isinstance(value, Tensor) and value.is_cuda:
                    value.record_stream(stream)


def _parts(keyframe: Keyframe) -> tuple[object, ...]:
    """Return all parts of a keyframe that are ever replaced."""
    k = keyframe
    return k.T_cw, k.inverse_depth, k.information, k.prior, k.scale, k.moving


R = TypeVar("R")

MAX_WAITING = 12
"""Waiting tasks above which mapping does not give way, so that it can catch up; each keyframe makes
two tasks, and a correction one."""


class BackgroundMapper:
    """Runs the tasks of a mapper in a thread, in order.

    The thread's mapper has its own copies of keyframes; each task first updates them to their state
    when the task was given. So neither thread sees the other in the middle of its work, and
    tracking only copies references. On a GPU the thread has its own stream, which gives way to the
    tracker's if that has a higher priority.
    """

    def __init__(
        self, keyframes: KeyframeTable, new_mapper: Callable[[KeyframeTable], Mapper]
    ) -> None:
        """``new_mapper`` makes a mapper for a table of keyframes."""
        self._keyframes = keyframes
        self._mirror = KeyframeMirror(keyframes)
        device = torch.device(keyframes.grid.device)
        self._stream = torch.cuda.Stream(device) if device.type == "cuda" else None
        self._mapper = new_mapper(self._mirror.table)
        self._mapper.pause = self._give_way
        # Longest wait of mapping between two parts of its work, while a frame is tracked.
        self._gate = PriorityGate(0.05)
        self._tasks: deque[Callable[[], None]] = deque()
        self._news = threading.Condition()
        self._is_closed = False
        self._failure: BaseException | None = None
        self.disks = 0
        """Disks in the map when a keyframe was last finished."""
        self._thread = threading.Thread(target=self._work, name="mapping", daemon=True)
        self._thread.start()

    def giving_way(self) -> AbstractContextManager[None]:
        """Return a context in which mapping gives way: a frame is being tracked."""
        return self._gate.taken()

    # --- tasks from tracking ---------------------------------------------------------------

    def observe(self, id: int, mask: Bool[np.ndarray, "h w"] | None = None) -> None:
        """See ``Mapper.observe``."""
        self._mirror.follow([id])
        self._tell(lambda mapper: mapper.observe(id, mask))

    def map_keyframe(self, id: int) -> None:
        """See ``Mapper.map_keyframe``."""
        self._tell(lambda mapper: mapper.map_keyframe(id))

    def correct(self, correction: PoseCorrection) -> None:
        """See ``Mapper.correct``."""
        self._tell(lambda mapper: mapper.correct(correction))

    def take_over(
        self, disks: MapSnapshot, masks: Mapping[int, Bool[np.ndarray, "h w"]], ids: Sequence[int]
    ) -> None:
        """See ``Mapper.take_over``."""
        self._mirror.follow(ids)
        self._tell(lambda mapper: mapper.take_over(disks, masks, ids))
        if self._stream is not None:
            torch.cuda.synchronize()  # the stream in which frames are tracked reads all this

    def ask(self, question: Callable[[Mapper], R]) -> R:
        """Return the answer of the mapper between two tasks.

        Waits for the running task, but not for other tasks given before.
        """
        answers: list[R] = []
        done = threading.Event()

        def answer() -> None:
            try:
                answers.append(question(self._mapper))
                wait_for(self._stream)
            finally:
                done.set()

        with self._news:
            self._raise()
            self._tasks.appendleft(answer)
            self._news.notify()
        while not done.wait(0.1):
            self._raise()
        self._raise()
        return answers[0]

    def settled(self) -> Mapper:
        """End the thread after all tasks; return the mapper, on the original keyframes."""
        with self._news:
            self._is_closed = True
            self._news.notify()
        self._thread.join()
        self._raise()
        self._mapper.pause = never_pause
        self._mapper.move_to(self._keyframes)
        return self._mapper

    # --- the hand-over ---------------------------------------------------------------------

    def _tell(self, what: Callable[[Mapper], object]) -> None:
        changed = self._mirror.changed()
        event = None
        if self._stream is not None:
            event = torch.cuda.Event()
            event.record()

        def task() -> None:
            if self._stream is not None and event is not None:
                self._stream.wait_event(event)
            self._mirror.update(changed, self._stream)
            what(self._mapper)
            self.disks = len(self._mapper.table.disks)

        with self._news:
            self._raise()
            self._tasks.append(task)
            self._news.notify()

    # --- the thread ------------------------------------------------------------------------

    def _work(self) -> None:
        torch.set_num_threads(1)
        with torch.cuda.stream(self._stream):
            while (task := self._next()) is not None:
                self._give_way()
                try:
                    task()
                except BaseException as error:
                    self._failure = error
                    self._tasks.clear()
                    return
            wait_for(self._stream)

    def _next(self) -> Callable[[], None] | None:
        with self._news:
            while not self._tasks and not self._is_closed:
                self._news.wait()
            return self._tasks.popleft() if self._tasks else None

    def _give_way(self) -> None:
        if len(self._tasks) <= MAX_WAITING and not self._is_closed:
            self._gate.give()

    def _raise(self) -> None:
        """Raise the error that ended the thread, if any."""
        if isinstance(self._failure, GeogsError | torch.cuda.OutOfMemoryError):
            raise self._failure
        if self._failure is not None:
            raise RuntimeError("mapping failed in its thread") from self._failure


def wait_for(stream: "torch.cuda.Stream | None") -> None:
    """Wait until a GPU stream is done; on a CPU (None) do nothing."""
    if stream is not None:
        stream.synchronize()
