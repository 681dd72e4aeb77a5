"""How a fleet tells how far it is and how long the rest will take."""

import time
from collections.abc import Callable

from geogs_fleet.row import Row


class FleetProgress:
    """Follows a fleet from outside; this one shows nothing. Override what you want to see."""

    def begin(self, sources: int, done_before: int, at_once: int) -> None:
        """Before the first source; so many can be computed at a time."""

    def ended(self, row: Row, left: int, seconds_left: float) -> None:
        """After each source; so many are left, for about so long."""


class Pace:
    """How long the sources that are left will take, from those that have ended."""

    def __init__(
        self, sources: int, at_once: int, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._left = sources
        self._at_once = max(at_once, 1)
        self._clock = clock
        self._begin = clock()
        self._ended = 0

    def after_one(self, seconds: float) -> tuple[int, float]:
        """Sources left, and seconds left, after one that took so long.

        The mean time between two ends so far; until there were as many as are computed at a time,
        this source's time over their number.
        """
        self._ended += 1
        self._left -= 1
        between = (self._clock() - self._begin) / self._ended
        if self._ended < self._at_once:
            between = min(between, seconds / min(self._at_once, self._left + 1))
        return self._left, between * self._left
