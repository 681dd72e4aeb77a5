"""What a benchmark is: scenes, variants of the settings, and the tables of its results."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from geogs_bench.data.benchmark_scene import BenchmarkScene, Option
from geogs_bench.data.motion_cells import Cell
from geogs_bench.published import PublishedTable
from geogs_bench.results.record import Record
from geogs_bench.runners.task import Command


@dataclass(frozen=True)
class Variant:
    """One row of an ablation: a name, and the options that make it."""

    name: str = ""
    """Also the folder below the scene's; none for a benchmark of one variant."""
    options: tuple[Option, ...] = ()
    command: Command | None = None
    """Other than the benchmark's."""
    needs_depth: bool = False
    """Whether only scenes whose images come with the depth of a sensor have it."""


@dataclass(frozen=True)
class Published:
    """The published figures that stand beside a column."""

    table: PublishedTable
    metric: str


@dataclass(frozen=True)
class Column:
    """A number of each record."""

    title: str
    """``{unit}`` stands for that of the surfaces."""
    value: Callable[[Record], float | None]
    digits: int = 2
    published: Published | None = None


@dataclass(frozen=True)
class Layout:
    """A table of results: which numbers under which heading."""

    title: str
    columns: tuple[Column, ...]
    note: str = ""


@dataclass(frozen=True)
class Benchmark:
    """One ``geogs bench NAME``."""

    name: str
    title: str
    command: Command
    find: Callable[[Path], list[BenchmarkScene]]
    needs: str
    """The folder that the user gives."""
    source: str
    """Where the data comes from."""
    layouts: tuple[Layout, ...]
    variants: tuple[Variant, ...] = (Variant(),)
    scenes: tuple[str, ...] = ()
    """Scenes of the paper; others are run only if asked for, or if none of these is there."""
    published: tuple[PublishedTable, ...] = ()
    notes: tuple[str, ...] = ()
    """What to know before comparing with the published figures."""
    budgets: tuple[float, ...] = ()
    """Seconds given to each reconstruction from known poses; each makes a variant."""
    cells: tuple[Cell, ...] = ()
    """Sequences that are rendered where the user gives no data."""


@dataclass(frozen=True)
class SuiteTable:
    """A benchmark of a suite, and what stands in where the user has no data for it."""

    benchmark: Benchmark
    find_stand_ins: Callable[[Path], list[BenchmarkScene]]
    """In the folder of what was rendered."""
    cells: tuple[Cell, ...]
    """What is rendered."""


@dataclass(frozen=True)
class Suite:
    """Several benchmarks in one ``geogs bench NAME``, in order."""

    name: str
    title: str
    needs: str
    source: str
    tables: tuple[SuiteTable, ...]
    options: tuple[Option, ...] = ()
    """Of every task."""
    takes_data: bool = True
    """Whether the user's data is looked for; else all are stand-ins."""
