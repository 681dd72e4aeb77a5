"""Wall-clock seconds per stage."""

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Stopwatch:
    """``with stopwatch("tracking"): ...`` adds to that stage's seconds.

    Inside another stage it adds nothing: the seconds of all stages never overlap.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.until_stream_end: float | None = None
        """Seconds of all stages up to the end of the stream; none before it."""
        self._is_running = False

    def __getstate__(self) -> dict[str, object]:
        """What a checkpoint holds: it is not running when that is read."""
        return {**self.__dict__, "_is_running": False}

    @property
    def total(self) -> float:
        """Seconds of all stages so far."""
        return sum(self.seconds.values())

    def end_stream(self) -> None:
        """What comes from now on comes after the stream."""
        self.until_stream_end = self.total

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        if self._is_running:
            yield
            return
        self._is_running, start = True, time.perf_counter()
        try:
            yield
        finally:
            self._is_running = False
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start
