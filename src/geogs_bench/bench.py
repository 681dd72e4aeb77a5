"""A benchmark from the user's options to its tables."""

import difflib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from geogs.errors import InputError
from geogs_bench.bench_options import BenchOptions
from geogs_bench.benchmark import Benchmark, Suite, SuiteTable
from geogs_bench.catalogue.ablations import ABLATIONS
from geogs_bench.catalogue.data_sets import DATA_SETS, EDGES
from geogs_bench.catalogue.paper_tables import SUITES
from geogs_bench.data.benchmark_scene import BenchmarkScene, Option
from geogs_bench.data.motion_cells import render_cells
from geogs_bench.harness import Harness, score_given
from geogs_bench.plan import BenchmarkJob, Selection, find_scenes, make_jobs, variants_of
from geogs_bench.runners.runner import Runner
from geogs_bench.runners.task import Task
from geogs_bench.tables.benchmark_report import Chapter, write_report


@dataclass(frozen=True)
class BenchResult:
    """The records of a benchmark or of a suite, and their folder."""

    output: Path
    """Folder of the results."""
    chapters: list[Chapter]
    """All records in the folder, with those of earlier calls."""


def bench(settings: BenchOptions, say: Callable[[str], None]) -> BenchResult:
    """Run and score every scene, and write the tables.

    Raises:
        InputError: the data, a setting or a name is wrong; found before anything is run.
        OutputError: the folder cannot be written.
    """
    name = _name(settings)
    output = settings.output or Path("out") / f"bench-{name}"

    def harness(benchmark: Benchmark, folder: Path) -> Harness:
        return Harness(benchmark, folder, Runner(), say, settings.fresh, settings.rescore)

    suite = SUITES.get(name)
    if settings.result is not None and (suite or find_benchmark(name) is not EDGES):
        raise InputError(f"--result is for {EDGES.name}; {name} scores its own runs.")
    if suite is not None:
        selection = _selection(settings)
        for table, chosen in wanted_tables(suite, selection):  # before anything is rendered
            Runner().settings(Task(table.benchmark.command, Path(), output, chosen.options))
        parts = suite_parts(suite, _data_of(settings, suite), output, selection, say)
        return BenchResult(output, run_parts(suite.title, parts, output, harness))
    benchmark = find_benchmark(name)
    if settings.result is not None:
        return _given(settings, benchmark, settings.result)
    selection = _selection(settings)
    data = settings.data or _made_data(benchmark, output, selection.scenes, say)
    scenes = find_scenes(benchmark, data.expanduser(), selection.scenes)
    jobs = make_jobs(benchmark, scenes, output, selection)
    records = harness(benchmark, output).run(jobs)
    return BenchResult(output, [Chapter(benchmark, records)])


def _data_of(settings: BenchOptions, suite: Suite) -> Path | None:
    """The user's data folder, if the suite takes one."""
    if settings.data is not None and not suite.takes_data:
        raise InputError(f"{suite.name} renders its own sequences; leave out the folder.")
    return None if settings.data is None else settings.data.expanduser()


def _given(settings: BenchOptions, benchmark: Benchmark, result: Path) -> BenchResult:
    """Score an earlier result."""
    if settings.data is None:
        raise InputError("--result needs the sequence that it was made of, too.")
    scenes = find_scenes(benchmark, settings.data.expanduser(), _names(settings.scenes))
    if len(scenes) != 1:
        names = ", ".join(scene.name for scene in scenes)
        raise InputError(f"--result is of one sequence; choose it by --scenes: {names}.")
    output = settings.output or result / f"bench-{benchmark.name}"
    records = score_given(benchmark, scenes[0], result, output)
    return BenchResult(output, [Chapter(benchmark, records)])


def _name(settings: BenchOptions) -> str:
    """Name of the benchmark, which some switches change."""
    name = settings.name
    if settings.known_poses:
        if name not in ("rooms", "rooms-known-poses"):
            raise InputError(f"--known-poses is for rooms; {name} has one way to run.")
        return "rooms-known-poses"
    if settings.small:
        small = f"{name.removesuffix('-small')}-small"
        if small not in BENCHMARKS and small not in SUITES:
            raise InputError(f"--small is for motions and paper; {name} has one size.")
        return small
    return name


def listing() -> str:
    """List the benchmarks with the data that each needs and its source."""
    lines = [
        "board",
        "  The whole on one page: commands on fixed sequences, three seeds each, beside a record",
        "  needs: nothing; data sets below a folder make more rows",
        "  from:  geogs synth",
        "sensitivity",
        "  The board with each of the --constants halved and doubled",
        "  needs: as the board",
        "  from:  geogs synth",
    ]
    tests: list[Suite | Benchmark] = [*SUITES.values(), *BENCHMARKS.values()]
    for test in tests:
        lines += [test.name, f"  {test.title}", f"  needs: {test.needs}", f"  from:  {test.source}"]
        variants = test.variants if isinstance(test, Benchmark) else ()
        names = ", ".join(variant.name for variant in variants if variant.name)
        lines += [f"  variants: {names}"] if names else []
    return "\n".join(lines)


def _selection(settings: BenchOptions) -> Selection:
    common = [Option("device", settings.device), Option("seed", str(settings.seed))]
    if settings.preset:
        common.append(Option("preset", settings.preset))
    if settings.depth_fusion:
        common.append(Option("depth-mesh"))
    return Selection(
        _names(settings.scenes),
        _names(settings.variants),
        (*common, *(_option(text) for text in settings.set)),
        settings.budgets,
        settings.baseline,
    )


def _option(text: str) -> Option:
    name, equals, value = text.partition("=")
    if not name or (equals and not value):
        raise InputError(f"--set {text} is no setting; give one such as mapping.iterations=12.")
    return Option(name.strip().removeprefix("--"), value.strip())


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


def _made_data(
    benchmark: Benchmark, output: Path, scenes: Sequence[str], say: Callable[[str], None]
) -> Path:
    """Render the data of a benchmark; return its folder. Raises InputError if it has none."""
    if benchmark.cells:
        return render_cells(benchmark.cells, output / "data", scenes, say)
    raise InputError(
        f"{benchmark.name} needs a folder: {benchmark.needs}; from {benchmark.source}."
    )


BENCHMARKS: dict[str, Benchmark] = {b.name: b for b in (*DATA_SETS, *ABLATIONS)}


def find_benchmark(name: str) -> Benchmark:
    """Find a benchmark by its name. Raises InputError with near names if there is none."""
    if name in BENCHMARKS:
        return BENCHMARKS[name]
    known = [*BENCHMARKS, *SUITES]
    near = difflib.get_close_matches(name, known, n=1)
    hint = f"did you mean {near[0]}?" if near else f"choose one of {', '.join(known)}."
    raise InputError(f"there is no benchmark {name}; {hint}")


_STAND_IN = (
    "stand-in",
    "synthetic stand-in",
    "Rooms of geogs synth stand in for the paper's scenes. What the paper prints of its own is no "
    "measure for these, and does not stand beside them.",
)
_OTHER = (
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
    suite: Suite, data: Path | None, output: Path, selection: Selection, say: Callable[[str], None]
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
            test = table.benchmark
            own = _chosen(scenes, selection.scenes, test.scenes)
            if test.published and not any(scene.name in test.scenes for scene in own):
                test = _marked(test, *_OTHER)
        else:
            own = _chosen(_stand_ins(table, folder), selection.scenes)
            test = _marked(table.benchmark, *_STAND_IN)
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
        made = []
        for part, own in zip(parts, harnesses, strict=True):
            name = part.benchmark.name
            records = [replace(r, folder=f"{name}/{r.folder}") for r in own.records(part.jobs)]
            made.append(Chapter(part.benchmark, records, f"{name}: "))
        return made

    for part, own in zip(parts, harnesses, strict=True):
        own.run(part.jobs, lambda _: write_report(output, title, chapters()))
    return chapters()


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


def _marked(benchmark: Benchmark, name: str, title: str, note: str) -> Benchmark:
    """Mark a benchmark with the kind of its scenes, and remove the published figures.

    ``name`` is the ending of the benchmark's name, and so of its folder.
    """
    layouts = tuple(
        replace(layout, columns=tuple(replace(c, published=None) for c in layout.columns))
        for layout in benchmark.layouts
    )
    return replace(
        benchmark,
        name=f"{benchmark.name}-{name}",
        title=f"{benchmark.title} ({title})",
        layouts=layouts,
        scenes=(),
        published=(),
        notes=(note, *benchmark.notes),
    )
