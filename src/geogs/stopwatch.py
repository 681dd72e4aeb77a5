"""Wall-clock seconds per stage, and its progress."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

StageProgress = Callable[[str, float], None]
"""Called with the name of a stage and its finished fraction in [0, 1]."""


def unwatched(stage: str, fraction: float) -> None:
    """Ignore the progress."""


@dataclass
class StageSeconds:
    """Seconds of each stage so far; mutable."""

    seconds: dict[str, float] = field(default_factory=dict)
    """Seconds by stage."""
    until_stream_end: float | None = None
    """Sum over all stages up to the end of the stream; None before it."""


class _Here(threading.local):
    """Flag of each thread."""

    is_aside = False


class Stopwatch:
    """``with stopwatch("tracking"): ...`` adds to that stage's seconds.

    Inside another stage, or in a thread that works ``aside``, it adds nothing: the seconds of all
    stages never overlap.
    """

    def __init__(self, times: StageSeconds | None = None) -> None:
        """``times``: seconds to add to."""
        self.times = times or StageSeconds()
        self._is_running = False
        self._here = _Here()

    @property
    def seconds(self) -> dict[str, float]:
        """Seconds by stage."""
        return self.times.seconds

    @property
    def until_stream_end(self) -> float | None:
        """Seconds of all stages up to the end of the stream; None before it."""
        return self.times.until_stream_end

    @property
    def total(self) -> float:
        """Seconds of all stages so far."""
        return sum(self.seconds.values())

    def end_stream(self) -> None:
        """Mark the end of the stream."""
        self.times.until_stream_end = self.total

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        if self._is_running or self._here.is_aside:
            yield
            return
        self._is_running = True
        start = time.perf_counter()
        try:
            yield
        finally:
            self._is_running = False
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Context in which this thread adds nothing: it works beside the one that is timed."""
        before = self._here.is_aside
        self._here.is_aside = True
        try:
            yield
        finally:
            self._here.is_aside = before
