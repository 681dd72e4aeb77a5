"""Progress on the terminal: one line with the stage and its remaining time; and a log."""

import logging
import math
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from geogs.application.machine.device import peak_memory
from geogs.application.progress.run_progress import RunProgress
from geogs.application.run_settings import Verbosity
from geogs.errors import OutputError
from geogs.evaluation.duration import duration
from geogs.guard.terminal_text import escape_records, printable

if TYPE_CHECKING:
    from geogs.pose_estimate import PoseEstimate

_LOG_SECONDS, _VERBOSE_SECONDS = 20.0, 2.0
"""Interval of text lines without a terminal, and with ``-v``."""

_REDRAWS = 4
"""Redraws per second; drawing the line holds the interpreter's lock for milliseconds."""


class TerminalProgress(RunProgress):
    """A line on the standard error, while it is entered and from the first report on.

    Without a terminal there is a line of text for every phase, and at intervals within one.
    """

    def __init__(self, verbosity: Verbosity | None = None) -> None:
        self._verbosity = verbosity or Verbosity()
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            TextColumn("{task.fields[percent]:>4}"),
            TextColumn("{task.fields[info]}"),
            TextColumn("{task.fields[left]}", style="cyan"),
            TextColumn("{task.fields[then]}", style="dim"),
            console=Console(stderr=True, quiet=self._verbosity.quiet, highlight=False),
            refresh_per_second=_REDRAWS,
            # Window for the pace of a stage, in seconds: first parts often differ.
            speed_estimate_period=60.0,
            transient=True,
        )
        self._task = self._bar.add_task(
            "", total=1.0, percent="", info="", left="", then="", start=False
        )
        self._frames: int | None = None
        self._dropped = 0
        self._printed = self._phase_began = time.perf_counter()
        self._phase = self._stage = self._last = ""
        self._stages: tuple[str, ...] = ()
        self._memory = ""
        self._measured = -math.inf
        self._log: logging.Handler | None = None
        self.warnings: list[str] = []
        """Warnings so far."""

    def __enter__(self) -> "TerminalProgress":
        if self._verbosity.log is not None:
            self._log = _opened(self._verbosity.log)
            logger = logging.getLogger("geogs")
            logger.addHandler(self._log)
            logger.setLevel(min(logger.level or logging.INFO, logging.INFO))
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.end_phase()
        if self._bar.live.is_started:  # stopping an unstarted bar would print an empty line
            self._bar.stop()
        if error is not None:
            self.note(f"ended by {kind.__name__ if kind else ''}: {error}")
        if self._log is not None:
            logging.getLogger("geogs").removeHandler(self._log)
            with suppress(OSError):  # the disk is full
                self._log.close()

    def write(self, text: str) -> None:
        """Print a line above the progress line, if it is not empty; with ``-q`` only warnings."""
        if not text:
            return
        self.note(text)
        if text.startswith("warning: "):
            self.warnings.append(text.removeprefix("warning: "))
            if self._verbosity.quiet:
                _print(Console(stderr=True, highlight=False), text)
        _print(self._bar.console, text)

    def stages(self, names: Sequence[str]) -> None:
        """Name all stages where there is no terminal; in its line the present one has a number."""
        self._stages = tuple(names)
        if names and not self._bar.console.is_terminal:
            self.write(f"Stages: {', '.join(names)}.")

    def expect(self, frames: int | None) -> None:
        """Begin with the frames."""
        self._frames = frames
        self._enter("frames")

    def dropped(self, frames: int) -> None:
        """Warn at the first dropped frame; then show their number in the line."""
        if not self._dropped:
            self.write(
                "warning: frames come faster than they are tracked, and some are dropped; a "
                "smaller --long-edge or --preset fast takes less time for each."
            )
        self._dropped = frames

    def frame(self, status: "PoseEstimate") -> None:
        """Update the line, with counts of keyframes, disks and memory."""
        done = None if self._frames is None else status.frames / max(self._frames, status.frames)
        parts = [f"{status.keyframes} keyframes"]
        if status.disks:  # else the map is made at the end
            parts.append(f"{status.disks / 1000:.1f}k disks")
        if self._dropped:
            parts.append(f"{self._dropped} dropped")
        info = "  ".join([*parts, self._memory_used()])
        if status.state.value != "tracking":
            info += f"  {status.state.value}"
        # Frames before the first keyframes take a different time.
        stage = "frames" if status.keyframes else "first frames"
        self._show(stage, f"frame {status.frames}/{self._frames or '?'}", info, done)

    def _memory_used(self) -> str:
        """Peak memory so far; measured no more often than the line is drawn."""
        now = time.perf_counter()
        if now - self._measured > 1 / _REDRAWS:
            self._memory = f"{peak_memory() / 2**30:.1f} GB"
            self._measured = now
        return self._memory

    def stage(self, name: str, fraction: float) -> None:
        """Move the line to a stage, or within it."""
        self._enter(name.split(":")[0])
        self._show(name, name, "", fraction)

    def _enter(self, phase: str) -> None:
        """Begin a phase, unless it is the present one."""
        if phase == self._phase:
            return
        self.end_phase()
        self._phase = phase
        self._phase_began = time.perf_counter()
        self._printed = self._phase_began

    def end_phase(self) -> None:
        """End the phase; its duration goes to the log, and to the terminal where text is shown."""
        if not self._phase:
            return
        seconds = time.perf_counter() - self._phase_began
        text = f"{self._phase}: {duration(seconds)}{self._last}"
        self._phase = self._last = ""
        self.note(text)
        if not self._bar.console.is_terminal or self._verbosity.verbose:
            _print(self._bar.console, text)

    def _show(self, stage: str, what: str, info: str, done: float | None) -> None:
        """Update the line, or print a line of text if it is time for one.

        ``done`` is the finished fraction of the stage; none where that is not known.
        """
        now = time.perf_counter()
        if stage != self._stage:
            self._stage = stage
            self._bar.reset(self._task)
        percent = "" if done is None else f"{done:.0%}"
        self._last = f", {info}" if info else ""
        self._bar.update(self._task, completed=done or 0.0)
        left = self._bar.tasks[0].time_remaining
        ahead = "" if left is None else f"about {duration(left)} left of this stage"
        number, to_come = self._position()
        shown = " ".join(filter(None, (number, what)))
        self._bar.update(
            self._task,
            description=f"{shown:<20}",
            percent=percent,
            info=info,
            left=ahead,
            then=to_come,
        )
        if self._bar.console.is_terminal and not self._bar.live.is_started:
            self._bar.start()
        every = _VERBOSE_SECONDS if self._verbosity.verbose else _LOG_SECONDS
        if now - self._printed < every:
            return
        self._printed = now
        text = "  ".join(filter(None, (what, percent, info, ahead)))
        self.note(text)
        if not self._bar.console.is_terminal:
            _print(self._bar.console, text)

    def _position(self) -> tuple[str, str]:
        """Number of the present stage among all, and the names of those to come, in words."""
        if self._phase not in self._stages:
            return "", ""
        place = self._stages.index(self._phase)
        later = self._stages[place + 1 :]
        return f"{place + 1}/{len(self._stages)}", f"then {', '.join(later)}" if later else ""

    def note(self, text: str) -> None:
        """Write a line to the log only, if there is one."""
        if self._log is not None:
            self._log.handle(logging.makeLogRecord({"msg": text}))


def _print(console: Console, text: str) -> None:
    console.print(printable(text), soft_wrap=True, markup=False)


def _opened(path: Path) -> logging.Handler:
    """Open a log for appending. Raises OutputError if it cannot be written."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        log = logging.FileHandler(path, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path} cannot be written ({error.strerror}).") from None
    log.setLevel(logging.INFO)
    escape_records(log)
    log.setFormatter(logging.Formatter("%(asctime)s %(message)s", "%Y-%m-%d %H:%M:%S"))
    return log
