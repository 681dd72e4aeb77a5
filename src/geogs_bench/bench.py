"""A benchmark from the user's options to its tables."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from geogs.errors import InputError
from geogs_bench.bench_options import BenchOptions
from geogs_bench.benchmark import Benchmark
from geogs_bench.catalogue.registry import BENCHMARKS, EDGES, find_benchmark
from geogs_bench.data.benchmark_scene import Option
from geogs_bench.data.motion_cells import render_cells
from geogs_bench.harness import Harness, score_given
from geogs_bench.plan import Selection, find_scenes, make_jobs
from geogs_bench.results.record import Record
from geogs_bench.runners.runner import Runner

_FRAMES, _WIDTH, _HEIGHT = 280, 640, 480
"""Frames, in which the path comes back to its start, and their size."""


@dataclass(frozen=True)
class BenchResult:
    """The records of a benchmark and where they are."""

    benchmark: Benchmark
    output: Path
    """Folder of the results."""
    records: list[Record]
    """All in the folder, earlier calls' included."""


def bench(settings: BenchOptions, say: Callable[[str], None]) -> BenchResult:
    """Run and score every scene, and write the tables.

    Raises:
        InputError: the data, a setting or a name is wrong; found before anything is run.
        OutputError: the folder cannot be written.
    """
    benchmark = find_benchmark(_name(settings))
    if settings.result is not None:
        return _given(settings, benchmark, settings.result)
    selection = _selection(settings, benchmark)
    output = settings.output or Path("out") / f"bench-{benchmark.name}"
    data = settings.data or _made_data(benchmark, output, selection.scenes, say)
    scenes = find_scenes(benchmark, data.expanduser(), selection.scenes)
    jobs = make_jobs(benchmark, scenes, output, selection)
    harness = Harness(
        benchmark, output, Runner(), say, fresh=settings.fresh, rescore=settings.rescore
    )
    return BenchResult(benchmark, output, harness.run(jobs))


def _given(settings: BenchOptions, benchmark: Benchmark, result: Path) -> BenchResult:
    """Score a result of earlier."""
    if benchmark is not EDGES:
        raise InputError(f"--result is for {EDGES.name}; {benchmark.name} scores its own runs.")
    if settings.data is None:
        raise InputError("--result needs the sequence that it was made of, too.")
    scenes = find_scenes(benchmark, settings.data.expanduser(), _names(settings.scenes))
    if len(scenes) != 1:
        names = ", ".join(scene.name for scene in scenes)
        raise InputError(f"--result is of one sequence; choose it by --scenes: {names}.")
    output = settings.output or result / f"bench-{benchmark.name}"
    return BenchResult(benchmark, output, score_given(benchmark, scenes[0], result, output))


def _name(settings: BenchOptions) -> str:
    """Name of the benchmark: some have another for a switch."""
    name = settings.name
    if settings.known_poses:
        if name not in ("rooms", "rooms-known-poses"):
            raise InputError(f"--known-poses is for rooms; {name} has one way to run.")
        return "rooms-known-poses"
    if settings.small:
        if name not in ("motions", "motions-small"):
            raise InputError(f"--small is for motions; {name} has one size.")
        return "motions-small"
    return name


def listing() -> str:
    """Which benchmarks there are, what data each needs and where that comes from."""
    lines = [
        "board",
        "  The whole on one page: commands on fixed sequences, three seeds each, beside a record",
        "  needs: nothing; data sets below a folder make more rows",
        "  from:  geogs synth",
    ]
    for benchmark in BENCHMARKS.values():
        lines += [benchmark.name, f"  {benchmark.title}", f"  needs: {benchmark.needs}"]
        lines += [f"  from:  {benchmark.source}"]
        variants = ", ".join(variant.name for variant in benchmark.variants if variant.name)
        lines += [f"  variants: {variants}"] if variants else []
    return "\n".join(lines)


def _selection(settings: BenchOptions, benchmark: Benchmark) -> Selection:
    common = [Option("device", settings.device), Option("seed", str(settings.seed))]
    if settings.preset:
        common.append(Option("preset", settings.preset))
    if settings.depth_fusion:
        common.append(Option("depth-mesh"))
    if benchmark.command == "run" and benchmark.keeps_online:
        common.append(Option("online-results"))
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
    """What can be rendered, where that serves. Raises InputError where it does not."""
    if benchmark.cells:
        return render_cells(benchmark.cells, output / "data", scenes, say)
    if not benchmark.synthetic:
        raise InputError(
            f"{benchmark.name} needs a folder: {benchmark.needs}; from {benchmark.source}."
        )
    from geogs_synth.sequence.replica_files import write_sequence

    say("no data given; rendering a synthetic room")
    room = output / "data" / "synthetic-0"
    # Written last, so that a room which was cut off is made again.
    if not (room / "points_seen_1cm.ply").is_file():
        write_sequence(room, _FRAMES, _WIDTH, _HEIGHT, seed=0, depth=False)
    return room.parent
