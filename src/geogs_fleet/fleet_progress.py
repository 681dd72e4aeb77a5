"""Progress of a fleet, and its estimated remaining time."""

import time
from collections.abc import Callable

from geogs_fleet.row import Row


class FleetProgress:
    """Receives the progress of a fleet; this one shows nothing. Override what you want to see."""

    def begin(self, sources: int, done_before: int, at_once: int) -> None:
        """Called before the first source; ``at_once`` sources can be computed at a time."""

    def ended(self, row: Row, left: int, seconds_left: float) -> None:
        """Called after each source; ``left`` sources remain, for about ``seconds_left``."""


class Pace:
    """Estimate of the remaining time, from the sources that have ended."""

    def __init__(
        self, sources: int, at_once: int, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._left = sources
        self._at_once = max(at_once, 1)
        self._clock = clock
        self._begin = clock()
        self._ended = 0

    def after_one(self, seconds: float) -> tuple[int, float]:
        """Sources left, and seconds left, after a source that took ``seconds``.

        It uses the mean time between two ends so far; until ``at_once`` sources have ended, at most
        this source's time over the number of concurrent ones.
        """
        self._ended += 1
        self._left -= 1
        between = (self._clock() - self._begin) / self._ended
        if self._ended < self._at_once:
            between = min(between, seconds / min(self._at_once, self._left + 1))
        return self._left, between * self._left
