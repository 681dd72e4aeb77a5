"""Profile of ``geogs run``, from the command to its exit.

    python benchmarks/run_profile.py SOURCE [--device cpu] [--functions 10] [--config.key VALUE ...]

Start-up is measured in separate processes: the help, PyTorch's import, all imports of a run. The
whole command is another one, with its files in a folder that is deleted again. Then the same run is
made in this process, and two times of every stage are printed: wall-clock time, and CPU time of all
threads of the process, which is also valid on a shared machine. The time of a nested stage is not
counted in the outer one. With ``--functions N`` a second run follows under Python's profiler, and
the N costliest functions of each stage are printed; compiled loops and PyTorch's operators appear
under the function that calls them or their own names. Only Python 3.11 can do that: later ones
count all threads in one profile.
"""

import argparse
import cProfile
import os
import pstats
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from geogs.application.calibrate import self_calibrated
from geogs.application.machine.device import compile_gpu_kernels
from geogs.application.results.result import Result
from geogs.application.results.write import write_results
from geogs.cli.options import parse_options
from geogs.config import Config
from geogs.io.sources.sniff import open_source
from geogs.slam import Slam
from geogs.stopwatch import Stopwatch
from geogs.threads import on_one_torch_thread, worker_count

STARTS = {
    "geogs run --help": "from geogs.cli.main import main; main(['run', '--help'])",
    "import torch": "import torch",
    "imports of geogs run": (
        "import geogs.application.run, geogs.application.progress.terminal_progress"
    ),
}
"""Code of the separate processes whose start-up is measured."""
LEAST_SHARE = 0.01
"""Fraction of a stage's time below which a function is not printed."""


class StageMeter(Stopwatch):
    """A stopwatch that also counts CPU seconds, and can profile each stage.

    Unlike in a run, the time of a nested stage is not counted in the outer one.
    """

    def __init__(self, profiles: bool) -> None:
        super().__init__()
        self.processor: dict[str, float] = {}
        self.profiles: dict[str, cProfile.Profile] = {}
        self._with_profiles = profiles
        self._stages: list[str] = []
        self._since = (0.0, 0.0)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        if self._here.is_aside:
            yield
            return
        self._settle()
        self._stages.append(stage)
        self._follow(True)
        try:
            yield
        finally:
            self._settle()
            self._stages.pop()
            self._follow(True)

    def _settle(self) -> None:
        """Add the seconds since the current stage began or resumed to it."""
        now = (time.perf_counter(), time.process_time())
        if self._stages:
            stage, (wall, processor) = self._stages[-1], self._since
            self.seconds[stage] = self.seconds.get(stage, 0.0) + now[0] - wall
            self.processor[stage] = self.processor.get(stage, 0.0) + now[1] - processor
            self._follow(False)

    def _follow(self, begins: bool) -> None:
        """Resume or suspend the current stage."""
        self._since = (time.perf_counter(), time.process_time())
        if self._with_profiles and self._stages:
            stage = self._stages[-1]
            profile = self.profiles.setdefault(stage, cProfile.Profile(time.thread_time))
            profile.enable() if begins else profile.disable()


def start_up(code: str) -> tuple[float, float]:
    """Wall-clock and CPU seconds of a new interpreter for some code."""
    measure = (
        f"import sys, time; out, sys.stdout = sys.stdout, sys.stderr\n{code}\n"
        "print(time.process_time(), file=out)"
    )
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", measure], check=True, capture_output=True, text=True
    )
    return time.perf_counter() - start, float(done.stdout)


def whole_command(source: Path, device: str, options: list[str]) -> tuple[float, float]:
    """Wall-clock and CPU seconds of ``geogs run`` in its own process.

    Raises:
        CalledProcessError: it failed; its output has been printed.
    """
    before, start = os.times(), time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        call = ["run", str(source), "-o", folder, "--device", device, "--quiet", "--no-strict"]
        call += options
        subprocess.run([sys.executable, "-m", "geogs.cli.main", *call], check=True)
    wall, after = time.perf_counter() - start, os.times()
    spent = after.children_user - before.children_user
    return wall, spent + after.children_system - before.children_system


@on_one_torch_thread
def measured_run(
    source: Path, config: Config, device: str, profiles: bool
) -> tuple[StageMeter, float, int]:
    """Run to the report; return the meter, CPU seconds to the first tracked frame, and frames."""
    meter, start, first = StageMeter(profiles), time.process_time(), float("nan")
    with meter("opening"):
        compile_gpu_kernels(torch.device(device))
        stream = open_source((source,), config.input)
    with meter("calibration"):
        stream = self_calibrated(stream, config, device)
    with meter("making the system"):
        at_end = config.mapping.when != "online"  # as in a run from files
        slam = Slam(stream.camera, config, device, mask=stream.mask, defers_map=at_end)
    slam.stopwatch = slam.executor.stopwatch = meter
    frames = iter(stream)
    while True:
        with meter("reading"):
            frame = next(frames, None)
        if frame is None:
            break
        slam.process(frame)
        if slam.frames == 1:
            first = time.process_time() - start
    slam.finish()
    with tempfile.TemporaryDirectory() as folder, meter("other files"):
        write_results(folder, Result(slam, stream))
    return meter, first, slam.frames


def print_functions(meter: StageMeter, count: int, show: Callable[[str], None] = print) -> None:
    """Print the costliest functions of each stage by their own seconds, with compiled ones."""
    for stage, profile in meter.profiles.items():
        entries = pstats.Stats(profile).stats  # type: ignore[attr-defined]
        total = sum(entry[2] for entry in entries.values())
        if total < LEAST_SHARE * sum(meter.processor.values()):
            continue
        show(f"\n{stage}: {total:.2f} s in its own thread, under the profiler")
        costliest = sorted(entries.items(), key=lambda item: -item[1][2])[:count]
        for (file, line, name), (_, calls, own, whole, _) in costliest:
            if own >= LEAST_SHARE * total:
                where = f"{'/'.join(Path(file).parts[-2:])}:{line} " if line else ""
                show(f"  {own:7.2f} s own {whole:7.2f} s in all {calls:8d} calls  {where}{name}")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("source", type=Path)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--functions", type=int, default=0)
    given, rest = parser.parse_known_args()
    if given.functions and sys.version_info >= (3, 12):
        parser.error("--functions needs Python 3.11")
    config = parse_options(Config, rest, "run")
    imports = 0.0
    for name, code in STARTS.items():
        wall, processor = min(start_up(code) for _ in range(3))
        imports = processor
        print(f"{name:<26} {wall:7.2f} s wall {processor:7.2f} s CPU", flush=True)
    wall, processor = whole_command(given.source, given.device, rest)
    print(f"{'the whole command':<26} {wall:7.2f} s wall {processor:7.2f} s CPU", flush=True)
    meter, first, frames = measured_run(given.source, config, given.device, profiles=False)
    print(f"\n{frames} frames on {given.device}, {worker_count()} threads of the kernels;")
    print(f"first frame tracked {first:.2f} s of CPU after the imports, {imports + first:.2f}")
    print("after the command\n")
    print_stages(meter)
    if given.functions:
        meter, _, _ = measured_run(given.source, config, given.device, profiles=True)
        print_functions(meter, given.functions)


def print_stages(meter: StageMeter, show: Callable[[str], None] = print) -> None:
    """Print the seconds of each stage, the longest first."""
    total, total_cpu = meter.total, sum(meter.processor.values())
    for stage, seconds in sorted(meter.seconds.items(), key=lambda item: -item[1]):
        processor = meter.processor[stage]
        share = processor / max(total_cpu, 1e-9)
        show(f"{stage:<26} {seconds:7.2f} s wall {processor:7.2f} s CPU {share:6.1%}")
    show(f"{'total':<26} {total:7.2f} s wall {total_cpu:7.2f} s CPU")


if __name__ == "__main__":
    main()
