"""A benchmark from the user's options to its tables."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from geogs.errors import InputError
from geogs_bench.bench_options import BenchOptions
from geogs_bench.benchmark import Benchmark, Suite
from geogs_bench.catalogue.data_sets import EDGES
from geogs_bench.catalogue.paper_tables import SUITES
from geogs_bench.catalogue.registry import BENCHMARKS, find_benchmark
from geogs_bench.data.benchmark_scene import Option
from geogs_bench.data.motion_cells import render_cells
from geogs_bench.harness import Harness, score_given
from geogs_bench.plan import Selection, find_scenes, make_jobs
from geogs_bench.runners.runner import Runner
from geogs_bench.runners.task import Task
from geogs_bench.suite import run_parts, suite_parts, wanted_tables
from geogs_bench.tables.benchmark_report import Chapter


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

    if name in SUITES:
        suite, selection = SUITES[name], _selection(settings)
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
    if settings.result is not None:
        raise InputError(f"--result is for {EDGES.name}; {suite.name} scores its own runs.")
    if settings.data is not None and not suite.takes_data:
        raise InputError(f"{suite.name} renders its own sequences; leave out the folder.")
    return None if settings.data is None else settings.data.expanduser()


def _given(settings: BenchOptions, benchmark: Benchmark, result: Path) -> BenchResult:
    """Score an earlier result."""
    if benchmark is not EDGES:
        raise InputError(f"--result is for {EDGES.name}; {benchmark.name} scores its own runs.")
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
