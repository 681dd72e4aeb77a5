"""One command of a benchmark on one source."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from geogs_bench.data.benchmark_scene import Option

Command = Literal["run", "track", "update", "reconstruct", "colour-2dgs"]
"""SLAM, its tracking alone, one saved map corrected by a rule, the map from known poses, or the
baseline with colour from known poses."""


@dataclass(frozen=True)
class Task:
    """One command on one source."""

    command: Command
    source: Path
    output: Path
    options: tuple[Option, ...] = ()
