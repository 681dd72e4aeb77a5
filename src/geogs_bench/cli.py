"""``geogs bench NAME [DATA]``: a benchmark in one command, with its tables as files."""

import itertools
import sys
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import asdict, dataclass, replace
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from geogs.cli.options import parse_options
from geogs.errors import InputError

if TYPE_CHECKING:
    from geogs.cli.reconstruct import ReconstructOptions
    from geogs.cli.run import RunOptions
    from geogs_bench.benchmark import Benchmark
    from geogs_bench.plan import Wishes
    from geogs_bench.record import Record
    from geogs_bench.runner import Command, Runner, Task
    from geogs_bench.scene import Option

_SHORT = {"-o": "--output"}


@dataclass(frozen=True)
class BenchOptions:
    """Run a benchmark on your copy of its data, score it, write the tables.

    ``geogs bench list`` says which there are, what data each needs and where to get it. What was
    finished before in the same folder is not run again.
    """

    name: Annotated[str, tyro.conf.Positional]
    """Which benchmark, or list."""
    data: Annotated[Path | None, tyro.conf.Positional] = None
    """Folder of the data set; some benchmarks make a synthetic room without one."""
    output: Path | None = None
    """Folder for the results (also -o); out/bench-NAME if none is given."""
    scenes: str = ""
    """Only these scenes, by their names with commas between."""
    variants: str = ""
    """Only these variants of an ablation, with commas between."""
    known_poses: bool = False
    """Of rooms: reconstruct from known poses instead of SLAM."""
    budgets: str = ""
    """From known poses: seconds given to each reconstruction, several with commas between."""
    baseline: bool = False
    """From known poses: 2D Gaussian splatting with colour beside it, in the same time (gsplat)."""
    depth_fusion: bool = False
    """Score the keyframes' depths fused without the disks, too: what the disks add to them."""
    device: str = "auto"
    """As in geogs run."""
    seed: int = 0
    """As in geogs run."""
    preset: str = ""
    """As in geogs run and geogs reconstruct; without one, what they choose."""
    settings: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(name="set", metavar="KEY=VALUE")
    ] = ()
    """Any option of geogs run or geogs reconstruct (--set mapping.iterations=12); repeatable."""
    fresh: bool = False
    """Run everything again."""
    rescore: bool = False
    """Score what was run before again."""


def main(argv: Sequence[str]) -> int:
    """Run the command; returns the exit code: 0 if every scene was scored, else 2."""
    options = parse_options(BenchOptions, argv, "bench", short=_SHORT)
    if options.name == "list":
        print(listing())
        return 0
    records = bench(options)
    return 2 if not records or any(record.error for record in records) else 0


def bench(options: BenchOptions) -> "list[Record]":
    """Run and score; prints the tables and where the files are."""
    from rich.console import Console

    from geogs_bench.harness import Harness
    from geogs_bench.plan import find_scenes, make_jobs
    from geogs_bench.registry import find_benchmark

    name = "rooms-known-poses" if options.known_poses else options.name
    if options.known_poses and options.name not in ("rooms", name):
        raise InputError(f"--known-poses is for rooms; {options.name} has one way to run.")
    benchmark = find_benchmark(name)
    wishes = _wishes(options, benchmark)
    output = options.output or Path("out") / f"bench-{benchmark.name}"
    data = options.data or _made_data(benchmark, output)
    scenes = find_scenes(benchmark, data.expanduser(), _names(options.scenes))
    jobs = make_jobs(benchmark, scenes, output, wishes)
    harness = Harness(
        benchmark, output, runners(), _say, fresh=options.fresh, rescore=options.rescore
    )
    records = harness.run(jobs)
    _print_tables(Console(), benchmark, records)
    print(f"Results are in {output}/ (results.md, results.json, report/index.html)")
    return records


def listing() -> str:
    """What ``geogs bench list`` prints."""
    from geogs_bench.registry import BENCHMARKS

    lines = []
    for benchmark in BENCHMARKS.values():
        lines += [benchmark.name, f"  {benchmark.title}", f"  needs: {benchmark.needs}"]
        lines += [f"  from:  {benchmark.source}"]
        variants = ", ".join(variant.name for variant in benchmark.variants if variant.name)
        lines += [f"  variants: {variants}"] if variants else []
    return "\n".join(lines)


_NO_SETTINGS = {
    "run": ("output", "source", "resume", "checkpoint_every"),
    "reconstruct": ("output", "source"),
}
"""Options of each command that change nothing about its results."""


class CommandRunner:
    """Runs tasks by the functions behind ``geogs run`` and ``geogs reconstruct``."""

    def settings(self, task: "Task") -> dict[str, object]:
        """Every setting of the command but its output. Raises InputError for a wrong option."""
        options = asdict(_parsed(task))
        options |= options.pop("config", {})
        return {k: v for k, v in options.items() if k not in _NO_SETTINGS[task.command]}

    def run(self, task: "Task") -> None:
        """Run the command."""
        from geogs.cli.reconstruct import reconstruct
        from geogs.cli.run import RunOptions, run

        options = _parsed(task)
        if isinstance(options, RunOptions):
            run(replace(options, checkpoint_every=0.0))
        else:
            reconstruct(options)


def runners() -> "dict[Command, Runner]":
    """Who runs which command."""
    from geogs_bench.baseline import BaselineRunner

    command = CommandRunner()
    return {"run": command, "reconstruct": command, "colour-2dgs": BaselineRunner()}


def _parsed(task: "Task") -> "RunOptions | ReconstructOptions":
    """The options of a task, by the command's own parser."""
    from geogs.cli import reconstruct, run

    argv = [str(task.source), "-o", str(task.output)]
    argv += [argument for option in task.options for argument in option.arguments()]
    said = StringIO()
    try:
        with redirect_stderr(said), redirect_stdout(said):
            return run.parse(argv) if task.command == "run" else reconstruct.parse(argv)
    except SystemExit:
        raise InputError(_why(task, said.getvalue())) from None


def _why(task: "Task", said: str) -> str:
    """One sentence from the parser's box: what stands between its rulers."""
    lines = [line.strip("│╭╮╰╯| ") for line in said.splitlines()]
    told = itertools.takewhile(lambda line: line.strip("─-+"), lines[2:])
    return f"geogs {task.command}: {' '.join(told).rstrip('.')}."


def _wishes(options: BenchOptions, benchmark: "Benchmark") -> "Wishes":
    from geogs.cli.reconstruct import seconds
    from geogs_bench.plan import Wishes
    from geogs_bench.scene import Option

    common = [Option("device", options.device), Option("seed", str(options.seed))]
    if options.preset:
        common.append(Option("preset", options.preset))
    if options.depth_fusion:
        common.append(Option("depth-mesh"))
    if benchmark.command == "run":
        common.append(Option("online-results"))
    return Wishes(
        _names(options.scenes),
        _names(options.variants),
        (*common, *(_option(text) for text in options.settings)),
        tuple(seconds(text) for text in _names(options.budgets)),
        options.baseline,
    )


def _option(text: str) -> "Option":
    from geogs_bench.scene import Option

    name, equals, value = text.partition("=")
    if not name or (equals and not value):
        raise InputError(f"--set {text} is no setting; give one such as mapping.iterations=12.")
    return Option(name.strip().removeprefix("--"), value.strip())


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


def _made_data(benchmark: "Benchmark", output: Path) -> Path:
    """A synthetic room where that serves. Raises InputError where it does not."""
    from geogs_bench.synthetic import no_data, synthetic_rooms

    if not benchmark.synthetic:
        raise no_data(benchmark.name, benchmark.needs, benchmark.source)
    _say("no data given; rendering a synthetic room")
    return synthetic_rooms(output / "data", (0,))


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _print_tables(console: object, benchmark: "Benchmark", records: "Sequence[Record]") -> None:
    from rich.table import Table

    from geogs_bench.tables import result_tables

    for table in result_tables(benchmark, records):
        shown = Table(*table.header, title=table.title, caption=table.note or None)
        for column in shown.columns[1:]:
            column.justify = "right"
        for row in table.rows:
            shown.add_row(*row)
        console.print(shown)  # type: ignore[attr-defined]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
