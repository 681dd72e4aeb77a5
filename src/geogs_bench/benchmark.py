"""Definition of a benchmark: scenes, variants of the settings, and the tables of its results."""

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
    """Also the name of the folder below the scene's; empty in a benchmark of one variant."""
    options: tuple[Option, ...] = ()
    command: Command | None = None
    """Command, if not the benchmark's."""
    needs_depth: bool = False
    """Whether it runs only on scenes with the depth images of a sensor."""


@dataclass(frozen=True)
class Published:
    """The published figures beside a column."""

    table: PublishedTable
    metric: str


@dataclass(frozen=True)
class Column:
    """A column of a table: a number of each record."""

    title: str
    """Title; ``{unit}`` is replaced by the unit of the surfaces."""
    value: Callable[[Record], float | None]
    digits: int = 2
    published: Published | None = None


@dataclass(frozen=True)
class Layout:
    """A table of results: its title and columns."""

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
    """Description of the folder that the user gives."""
    source: str
    """Source of the data."""
    layouts: tuple[Layout, ...]
    variants: tuple[Variant, ...] = (Variant(),)
    scenes: tuple[str, ...] = ()
    """Scenes of the paper; others are run only by name, or if none of these is there."""
    published: tuple[PublishedTable, ...] = ()
    notes: tuple[str, ...] = ()
    """Notes on the comparison with the published figures."""
    budgets: tuple[float, ...] = ()
    """Seconds given to each reconstruction from known poses; each makes a variant."""
    cells: tuple[Cell, ...] = ()
    """Sequences that are rendered if the user gives no data."""


@dataclass(frozen=True)
class SuiteTable:
    """A benchmark of a suite, and its stand-ins if the user has no data for it."""

    benchmark: Benchmark
    find_stand_ins: Callable[[Path], list[BenchmarkScene]]
    """Finds the stand-ins in the folder of the rendered sequences."""
    cells: tuple[Cell, ...]
    """Sequences to render."""


@dataclass(frozen=True)
class Suite:
    """Several benchmarks in one ``geogs bench NAME``, in order."""

    name: str
    title: str
    needs: str
    source: str
    tables: tuple[SuiteTable, ...]
    options: tuple[Option, ...] = ()
    """Options of every task."""
    takes_data: bool = True
    """Whether the user's data is used; else all scenes are stand-ins."""
