"""What the harness asks of the commands, so that it need not know the command line."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

from geogs_bench.data.benchmark_scene import Option

Command = Literal["run", "track", "update", "reconstruct", "colour-2dgs"]
"""SLAM, its tracking alone, one map of it moved by a rule of its update, the map from known poses,
or the baseline with colour from known poses."""


@dataclass(frozen=True)
class Task:
    """One command on one source."""

    command: Command
    source: Path
    output: Path
    options: tuple[Option, ...] = ()

    def option(self, name: str) -> str | None:
        """The value of an option as given last, or none."""
        return next((o.value for o in reversed(self.options) if o.name == name), None)


@runtime_checkable
class Runner(Protocol):
    """Runs tasks into their folders."""

    def settings(self, task: Task) -> dict[str, object]:
        """Every setting with which the task would run, but for its output.

        Raises:
            InputError: an option does not exist, or its value is wrong.
        """
        ...

    def run(self, task: Task) -> None:
        """Run it; results lie in ``task.output`` then.

        Raises:
            GeogsError: it failed, in a sentence.
        """
        ...
