"""Several benchmarks into one folder: on the user's data if it is there, else on stand-ins."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from geogs.errors import InputError
from geogs_bench.benchmark import Benchmark, Suite, SuiteTable
from geogs_bench.data.benchmark_scene import BenchmarkScene
from geogs_bench.data.motion_cells import render_cells
from geogs_bench.harness import Harness
from geogs_bench.plan import BenchmarkJob, Selection, make_jobs, variants_of
from geogs_bench.results.record import Record
from geogs_bench.tables.benchmark_report import Chapter, write_report


@dataclass(frozen=True)
class _Mark:
    """Reason to leave out the paper's figures."""

    name: str
    """Ending of the benchmark's name, and so of its folder."""
    title: str
    note: str


_STAND_IN = _Mark(
    "stand-in",
    "synthetic stand-in",
    "Rooms of geogs synth stand in for the paper's scenes. What the paper prints of its own is no "
    "measure for these, and does not stand beside them.",
)
_OTHER = _Mark(
    "other",
    "other scenes than the paper's",
    "None of the paper's scenes was there. What it prints of them is no measure for others, and "
    "does not stand beside them.",
)


@dataclass(frozen=True)
class SuitePart:
    """A benchmark of a suite with its jobs."""

    benchmark: Benchmark
    """Marked, and without published figures, if its scenes are not the paper's."""
    jobs: list[BenchmarkJob]


def suite_parts(
    suite: Suite,
    data: Path | None,
    output: Path,
    selection: Selection,
    say: Callable[[str], None],
) -> list[SuitePart]:
    """Jobs of each table: on the paper's scenes below ``data``, else on others there, else on
    stand-ins, which are rendered below ``output``.

    A table without any of the chosen scenes or variants is left out.

    Raises:
        InputError: no table has a chosen scene or variant, or ``data`` is no folder.
        OutputError: stand-ins cannot be written.
    """
    if data is not None and not data.is_dir():
        raise InputError(f"{data} is not a folder; {suite.name} needs {suite.needs}.")
    wanted = wanted_tables(suite, selection)
    found = [_scenes_below(data, table.benchmark) for table, _ in wanted]
    cells = {
        cell.name: cell
        for (table, _), scenes in zip(wanted, found, strict=True)
        if not scenes
        for cell in table.cells
    }
    known = [*dict.fromkeys(s.name for scenes in found for s in scenes), *cells]
    if missing := [name for name in selection.scenes if name not in known]:
        raise InputError(f"there is no scene {missing[0]}, only {', '.join(known)}.")
    asked = [c for c in cells.values() if c.name in (selection.scenes or known)]
    folder = render_cells(asked, output / "data", (), say)
    parts = []
    for (table, chosen), scenes in zip(wanted, found, strict=True):
        if scenes:
            own = _chosen(scenes, selection.scenes, table.benchmark.scenes)
            test = _for_scenes(table.benchmark, own)
        else:
            own = _chosen(_stand_ins(table, folder), selection.scenes)
            test = _marked(table.benchmark, _STAND_IN)
        if own:
            parts.append(SuitePart(test, make_jobs(test, own, output / test.name, chosen)))
    return parts


def _chosen(
    scenes: Sequence[BenchmarkScene], names: Sequence[str], papers: Sequence[str] = ()
) -> list[BenchmarkScene]:
    """The named scenes, else the paper's, else all."""
    if names:
        return [scene for scene in scenes if scene.name in names]
    return [scene for scene in scenes if scene.name in papers] or list(scenes)


def _for_scenes(benchmark: Benchmark, scenes: Sequence[BenchmarkScene]) -> Benchmark:
    """The benchmark, marked if papers printed figures, but of none of the scenes."""
    is_papers = any(scene.name in benchmark.scenes for scene in scenes)
    return benchmark if is_papers or not benchmark.published else _marked(benchmark, _OTHER)


def wanted_tables(suite: Suite, selection: Selection) -> list[tuple[SuiteTable, Selection]]:
    """The tables with a chosen variant, each with its part of the selection.

    Raises InputError if there are none.
    """
    selection = replace(selection, options=(*suite.options, *selection.options))
    wanted = [(t, s) for t in suite.tables if (s := _selected(t.benchmark, selection)) is not None]
    if not wanted:
        raise InputError(f"no table of {suite.name} has a variant {selection.variants[0]}.")
    return wanted


def run_parts(
    title: str,
    parts: Sequence[SuitePart],
    output: Path,
    harness: Callable[[Benchmark, Path], Harness],
) -> list[Chapter]:
    """Run all parts in order, each in its own folder; write the report of all after each job.

    Raises:
        InputError: an option does not exist or fit; found before anything is run.
        OutputError: the folder cannot be written.
    """
    harnesses = [harness(part.benchmark, output / part.benchmark.name) for part in parts]
    for part, own in zip(parts, harnesses, strict=True):
        own.check(part.jobs)

    def chapters() -> list[Chapter]:
        return [
            _chapter(part.benchmark, own.records(part.jobs))
            for part, own in zip(parts, harnesses, strict=True)
        ]

    for part, own in zip(parts, harnesses, strict=True):
        own.run(part.jobs, lambda _: write_report(output, title, chapters()))
    return chapters()


def _chapter(benchmark: Benchmark, records: Sequence[Record]) -> Chapter:
    own = [replace(record, folder=f"{benchmark.name}/{record.folder}") for record in records]
    return Chapter(benchmark, own, f"{benchmark.name}: ")


def _selected(benchmark: Benchmark, selection: Selection) -> Selection | None:
    """The part of a selection that concerns a benchmark; none if it has none of the variants."""
    if not benchmark.budgets:
        selection = replace(selection, budgets=(), baseline=False)
    known = {variant.name for variant in variants_of(benchmark, selection)}
    variants = tuple(name for name in selection.variants if name in known)
    return None if selection.variants and not variants else replace(selection, variants=variants)


def _scenes_below(data: Path | None, benchmark: Benchmark) -> list[BenchmarkScene]:
    """All scenes in a folder or in its subfolders; the first of each name."""
    if data is None:
        return []
    folders = [data, *sorted(path for path in data.iterdir() if path.is_dir())]
    found: dict[str, BenchmarkScene] = {}
    for scene in (scene for folder in folders for scene in benchmark.find(folder)):
        found.setdefault(scene.name, scene)
    return [*found.values()]


def _stand_ins(table: SuiteTable, folder: Path) -> list[BenchmarkScene]:
    """Stand-ins of the table that have been rendered."""
    names = {cell.name for cell in table.cells}
    found = table.find_stand_ins(folder) if folder.is_dir() else []
    return [scene for scene in found if scene.name in names]


def _marked(benchmark: Benchmark, mark: _Mark) -> Benchmark:
    """Mark a benchmark with the kind of its scenes, and remove the published figures."""
    layouts = tuple(
        replace(layout, columns=tuple(replace(c, published=None) for c in layout.columns))
        for layout in benchmark.layouts
    )
    return replace(
        benchmark,
        name=f"{benchmark.name}-{mark.name}",
        title=f"{benchmark.title} ({mark.title})",
        layouts=layouts,
        scenes=(),
        published=(),
        notes=(mark.note, *benchmark.notes),
    )
