"""Progress of a fleet, and its estimated remaining time."""

import time
from collections.abc import Callable

from rich.console import Console

from geogs.evaluation.duration import duration
from geogs.guard.terminal_text import printable
from geogs_fleet.table import Row


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


class TerminalFleet(FleetProgress):
    """Writes to the standard error, or nothing if it is quiet."""

    def __init__(self, quiet: bool = False) -> None:
        self._console = Console(stderr=True, quiet=quiet, highlight=False, soft_wrap=True)
        self._sources = 0

    def begin(self, sources: int, done_before: int, at_once: int) -> None:
        """Print the number of sources."""
        self._sources = sources
        before = f", {done_before} of them done before" if done_before else ""
        self.say(f"{_sources(sources)}{before}; {at_once} at a time.")

    def ended(self, row: Row, left: int, seconds_left: float) -> None:
        """Print the outcome of a source."""
        done = self._sources - left
        rest = f"; about {duration(seconds_left)} left" if left else ""
        how = "" if row.state == "done" else "failed: "
        head = f"{done}/{self._sources} {row.name} ({duration(row.seconds)}{rest})"
        self.say(f"{head}: {how}{row.sentence}")

    def say(self, sentence: str) -> None:
        """Print any other sentence."""
        self._console.print(printable(sentence), markup=False)


def closing_message(rows: list[Row], computed: int, output: str, seconds: float) -> list[str]:
    """Closing lines for the standard output."""
    failed = sum(row.state != "done" for row in rows)
    doubtful = sum(row.is_reliable is False for row in rows)
    parts = [f"{len(rows) - failed} of {_sources(len(rows))} done"]
    parts += [f"{failed} failed"] if failed else []
    parts += [f"{doubtful} not reliable"] if doubtful else []
    said = f"{', '.join(parts)}; {computed} computed in {duration(seconds)}."
    return [said, f"Open {output.rstrip('/')}/index.html in a browser."]


def _sources(number: int) -> str:
    return "1 source" if number == 1 else f"{number} sources"
