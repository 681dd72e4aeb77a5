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
        self._is_running = False

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
