"""One progress line: frames, frames/s, keyframes, disks, memory, time left."""

import sys
import time
from pathlib import Path
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

if TYPE_CHECKING:
    from geogs.slam import SlamStatus


_LOG_SECONDS = 2.0
"""Where no terminal redraws the bars, a line of text comes this often."""

_REDRAWS = 4
"""A second; drawing the bars holds the interpreter's lock for milliseconds."""


def peak_memory() -> int:
    """Largest resident size of this process so far, bytes."""
    import resource

    try:  # of this program alone: what the system counts begins with the size of who started it
        status = Path("/proc/self/status").read_text()
    except OSError:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else peak * 1024
    (line,) = (line for line in status.splitlines() if line.startswith("VmHWM:"))
    return int(line.split()[1]) * 1024


class RunProgress:
    """Shows how far a run is; a context manager, on the standard error."""

    def __init__(self, frames: int | None, tracks: bool = True, begun: int = 0):
        """Of a source of so many frames, if known; without ``tracks`` there are only stages.

        ``begun`` frames were done by an earlier process.
        """
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
        self._frames, self._begun = frames, begun
        self._start = self._printed = time.perf_counter()
        self._tasks: dict[str, TaskID] = {}
        if tracks:
            self._tasks["tracking"] = self._bar.add_task(
                "tracking", total=frames, completed=begun, info=""
            )

    def __enter__(self) -> "RunProgress":
        self._bar.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._bar.stop()

    def write(self, text: str) -> None:
        """A line above the bars, if there is something to say."""
        if text:
            self._bar.console.print(text)

    def frame(self, status: "SlamStatus") -> None:
        """After each frame."""
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
        """After each part of a later stage; ``fraction`` in [0, 1]."""
        if name not in self._tasks:
            self._tasks[name] = self._bar.add_task(name, total=1.0, info="")
        self._bar.update(self._tasks[name], completed=fraction)
