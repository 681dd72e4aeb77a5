"""A fleet on the terminal: a line for each source that ends, with the remaining time."""

from rich.console import Console

from geogs.evaluation.duration import duration
from geogs_fleet.fleet_progress import FleetProgress
from geogs_fleet.row import Row


class TerminalFleet(FleetProgress):
    """Writes to the standard error, or nothing if it is quiet."""

    def __init__(self, quiet: bool = False) -> None:
        self._console = Console(stderr=True, quiet=quiet, highlight=False, soft_wrap=True)
        self._sources = 0

    def begin(self, sources: int, done_before: int, at_once: int) -> None:
        """Print the number of sources."""
        self._sources = sources
        before = f", {done_before} of them done before" if done_before else ""
        self._console.print(f"{_sources(sources)}{before}; {at_once} at a time.", markup=False)

    def ended(self, row: Row, left: int, seconds_left: float) -> None:
        """Print the outcome of a source."""
        done = self._sources - left
        rest = f"; about {duration(seconds_left)} left" if left else ""
        how = "" if row.state == "done" else "failed: "
        head = f"{done}/{self._sources} {row.name} ({duration(row.seconds)}{rest})"
        self._console.print(f"{head}: {how}{row.sentence}", markup=False)

    def say(self, sentence: str) -> None:
        """Print any other sentence."""
        self._console.print(sentence, markup=False)


def closing_message(rows: list[Row], computed: int, output: str, seconds: float) -> str:
    """Closing message for the standard output."""
    failed = sum(row.state != "done" for row in rows)
    doubtful = sum(row.is_reliable is False for row in rows)
    parts = [f"{len(rows) - failed} of {_sources(len(rows))} done"]
    parts += [f"{failed} failed"] if failed else []
    parts += [f"{doubtful} not reliable"] if doubtful else []
    said = f"{', '.join(parts)}; {computed} computed in {duration(seconds)}."
    return f"{said}\nOpen {output.rstrip('/')}/index.html in a browser."


def _sources(number: int) -> str:
    return "1 source" if number == 1 else f"{number} sources"
