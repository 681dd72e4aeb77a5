"""Wall-clock seconds per stage."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass


@dataclass(frozen=True)
class StopwatchState:
    """What a checkpoint holds of a stopwatch; the fields are the stopwatch's."""

    seconds: dict[str, float]
    until_stream_end: float | None


class _Here(threading.local):
    """What is so in one thread and not in others."""

    is_aside = False


class Stopwatch:
    """``with stopwatch("tracking"): ...`` adds to that stage's seconds.

    Inside another stage it adds nothing, nor does a thread that works ``aside``: the seconds of all
    stages never overlap.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.until_stream_end: float | None = None
        """Seconds of all stages up to the end of the stream; none before it."""
        self._is_running = False
        self._here = _Here()

    def state(self) -> StopwatchState:
        """What a checkpoint holds."""
        return StopwatchState(dict(self.seconds), self.until_stream_end)

    def load(self, state: StopwatchState) -> None:
        """Go on from where another was."""
        self.seconds, self.until_stream_end = state.seconds, state.until_stream_end

    @property
    def total(self) -> float:
        """Seconds of all stages so far."""
        return sum(self.seconds.values())

    def end_stream(self) -> None:
        """What comes from now on comes after the stream."""
        self.until_stream_end = self.total

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        if self._is_running or self._here.is_aside:
            yield
            return
        self._is_running, start = True, time.perf_counter()
        try:
            yield
        finally:
            self._is_running = False
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start

    @contextmanager
    def aside(self) -> Iterator[None]:
        """What this thread does meanwhile, beside the one whose stages count, adds nothing."""
        before, self._here.is_aside = self._here.is_aside, True
        try:
            yield
        finally:
            self._here.is_aside = before
