"""A process of the soak: its start, a signal after a while, and its ending."""

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

GEOGS = [sys.executable, "-m", "geogs.cli.main"]
HANGS = 1800.0
"""Seconds after which a process counts as hanging; a third of that after a signal."""


class TimeIsUp(Exception):
    """The soak is over; the process was killed without checks."""


@dataclass(frozen=True)
class Ending:
    """Ending of a process."""

    code: int
    said: str
    """Text on its standard error."""
    seconds: float
    was_hit: bool = False
    """Whether it received the signal before it ended by itself."""
    hangs: bool = False

    @property
    def last(self) -> str:
        """Its last line."""
        lines = self.said.strip().splitlines() or [""]
        return lines[-1][:300]

    def wrong(self, codes: Sequence[int]) -> Iterator[str]:
        """Yield the faults of this ending, given the allowed exit codes."""
        if self.hangs:
            yield "it hangs"
        elif "Traceback" in self.said or self.code not in codes:
            yield f"ended with {self.code}: {self.last}"


def ended(
    command: Sequence[str],
    end: float,
    number: signal.Signals | None = None,
    after: float = 0.0,
    threads: str = "1",
) -> Ending:
    """Run a command to its end, or to that of the soak.

    Args:
        command: and its arguments.
        end: of the soak, a time of ``time.monotonic``.
        number: a signal to send, if any.
        after: seconds after which it is sent.
        threads: number of threads that the process may use.

    Raises:
        TimeIsUp: the soak ended first.
    """
    begin = time.monotonic()
    environment = {**os.environ, "OMP_NUM_THREADS": threads}
    with tempfile.TemporaryFile("w+", errors="replace") as said:
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=said, env=environment)
        was_hit = hangs = False
        if number is not None and not _is_over(process, min(after, end - begin)):
            process.send_signal(number)
            was_hit = True
        patience = HANGS / 3 if was_hit else HANGS
        if not _is_over(process, min(patience, end - time.monotonic())):
            hangs = time.monotonic() < end
            process.kill()
            process.wait()
            if not hangs:
                raise TimeIsUp
        said.seek(0)
        text = said.read()
    return Ending(process.returncode, text, time.monotonic() - begin, was_hit, hangs)


def _is_over(process: "subprocess.Popen[bytes]", seconds: float) -> bool:
    try:
        process.wait(max(seconds, 0.0))
    except subprocess.TimeoutExpired:
        return False
    return True
