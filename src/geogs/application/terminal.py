"""A run on the terminal: a line of frames, frames/s, keyframes, disks, memory, time left."""

import time
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    TaskID,
    TaskProgressColumn,
    TextColumn,
    TimeRemainingColumn,
)

from geogs.application.machine import peak_memory
from geogs.application.progress import RunProgress

if TYPE_CHECKING:
    from geogs.slam import SlamStatus


_LOG_SECONDS = 2.0
"""Where no terminal redraws the bars, a line of text comes this often."""

_REDRAWS = 4
"""A second; drawing the bars holds the interpreter's lock for milliseconds."""


class TerminalProgress(RunProgress):
    """Bars on the standard error, while it is entered and from the first of them on."""

    def __init__(self) -> None:
        self._console = Console(stderr=True)
        self._bar = Progress(
            TextColumn("{task.description:<18}"),
            BarColumn(bar_width=24),
            TaskProgressColumn(),
            TextColumn("{task.fields[info]}"),
            TimeRemainingColumn(compact=True),
            console=self._console,
            refresh_per_second=_REDRAWS,
        )
        self._frames: int | None = None
        self._begun = 0
        self._start = self._printed = time.perf_counter()
        self._tasks: dict[str, TaskID] = {}

    def __enter__(self) -> "TerminalProgress":
        return self

    def __exit__(self, *exception: object) -> None:
        if self._tasks:  # to stop what never began would print an empty line
            self._bar.stop()

    def write(self, text: str) -> None:
        """A line above the bars, if there is something to say."""
        if text:
            self._bar.console.print(text, markup=False)  # names may hold brackets

    def expect(self, frames: int | None, begun: int = 0) -> None:
        """Show the bar of the frames."""
        self._frames, self._begun = frames, begun
        self._start = self._printed = time.perf_counter()
        self._bar.start()
        self._tasks["tracking"] = self._bar.add_task(
            "tracking", total=frames, completed=begun, info=""
        )

    def frame(self, status: "SlamStatus") -> None:
        """Move the bar of the frames, with what there is to say beside it."""
        rate = (status.frames - self._begun) / max(time.perf_counter() - self._start, 1e-9)
        info = (
            f"{status.frames} frames  {rate:.1f}/s  {status.keyframes} keyframes  "
            f"{status.disks / 1000:.1f}k disks  {peak_memory() / 2**30:.1f} GB"
        )
        if status.state.value != "tracking":
            info += f"  [bold]{status.state.value}[/bold]"
        self._bar.update(self._tasks["tracking"], completed=status.frames, info=info)
        now = time.perf_counter()
        if not self._console.is_terminal and now - self._printed > _LOG_SECONDS:
            self._printed = now
            self._console.print(f"frame {status.frames}/{self._frames or '?'}: {info}")

    def stage(self, name: str, fraction: float) -> None:
        """Move the bar of a stage, or begin one."""
        if name not in self._tasks:
            self._bar.start()
            self._tasks[name] = self._bar.add_task(name, total=1.0, info="")
        self._bar.update(self._tasks[name], completed=fraction)
