"""The tasks of a benchmark, given the user's folder and selection."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from geogs.errors import InputError
from geogs_bench.benchmark import Benchmark, Variant
from geogs_bench.data.benchmark_scene import BenchmarkScene, Option
from geogs_bench.runners.task import Command, Task


@dataclass(frozen=True)
class Selection:
    """The user's choice of the scenes, variants and options of a benchmark."""

    scenes: tuple[str, ...] = ()
    """Names of the scenes; those of the paper if none is named."""
    variants: tuple[str, ...] = ()
    """Names of the variants; all if none is named."""
    options: tuple[Option, ...] = ()
    """Options of every task; a variant's own options win over them."""
    budgets: tuple[float, ...] = ()
    """Seconds of reconstructions from known poses; the benchmark's if none is given."""
    baseline: bool = False
    """Whether the baseline with colour runs too, from known poses."""


@dataclass(frozen=True)
class BenchmarkJob:
    """One future row of the results."""

    scene: BenchmarkScene
    variant: str
    task: Task


def find_scenes(
    benchmark: Benchmark, folder: Path, names: Sequence[str] = ()
) -> list[BenchmarkScene]:
    """Find the scenes to run: those named, else the paper's, else all that are there.

    Raises:
        InputError: there are none, or a named one is missing.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder; {benchmark.name} needs {benchmark.needs}.")
    found = {scene.name: scene for scene in benchmark.find(folder)}
    if not found:
        raise InputError(
            f"{folder} holds no scene of {benchmark.name}, which needs {benchmark.needs}."
        )
    if missing := [name for name in names if name not in found]:
        raise InputError(f"{folder} has no scene {missing[0]}, only {', '.join(found)}.")
    published = [name for name in benchmark.scenes if name in found]
    return [found[name] for name in names or published or found]


def make_jobs(
    benchmark: Benchmark, scenes: Sequence[BenchmarkScene], output: Path, selection: Selection
) -> list[BenchmarkJob]:
    """One job for each scene and variant, scene by scene; depth variants only with sensor depth.

    Raises:
        InputError: a named variant does not exist, or can be run on none of the scenes.
    """
    variants = variants_of(benchmark, selection)
    known = [variant.name for variant in variants]
    if missing := [name for name in selection.variants if name not in known]:
        raise InputError(
            f"{benchmark.name} has no variant {missing[0]}, only {', '.join(known) or 'one'}."
        )
    chosen = [v for v in variants if v.name in selection.variants or not selection.variants]
    jobs = []
    for scene in scenes:
        for variant in chosen:
            if scene.has_depth or not variant.needs_depth:
                options = merged(scene.options, selection.options, variant.options)
                command = variant.command or benchmark.command
                folder = output / scene.name / variant.name
                task = Task(command, scene.source, folder, options)
                jobs.append(BenchmarkJob(scene, variant.name, task))
    if not jobs and scenes:
        names = ", ".join(v.name for v in chosen)
        raise InputError(f"No scene has depth images, which {names} needs.")
    return jobs


def variants_of(benchmark: Benchmark, selection: Selection) -> list[Variant]:
    """The benchmark's variants, at each budget, and the baseline at each."""
    variants = list(benchmark.variants)
    budgets = selection.budgets or benchmark.budgets
    if not benchmark.budgets:
        if selection.budgets or selection.baseline:
            raise InputError(
                f"{benchmark.name} does not start from known poses; leave out --budgets and "
                f"--baseline."
            )
        return variants
    if selection.baseline:
        command: Command = "colour-2dgs"
        variants.append(Variant(command, command=command))
    timed = []
    for variant in variants:
        for seconds in budgets:
            budget = f"{seconds:g}s"
            name = variant.name
            if len(budgets) > 1 or not name:
                name = f"{name}-{budget}".removeprefix("-")
            options = (*variant.options, Option("budget", budget))
            timed.append(replace(variant, name=name, options=options))
    return timed


def merged(*groups: Sequence[Option]) -> tuple[Option, ...]:
    """All options, each once; later ones win."""
    values = {option.name.replace("_", "-"): option.value for group in groups for option in group}
    return tuple(Option(name, value) for name, value in values.items())
