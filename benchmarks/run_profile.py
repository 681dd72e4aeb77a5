"""Where a second of ``geogs run`` goes: by stage, and by function within a stage.

    python benchmarks/run_profile.py SOURCE [--device cpu] [--functions 10] [--config.key VALUE ...]

Start-up is measured in processes of their own: the help, PyTorch's import, all imports of a run.
Then the run is made here, the report included, into a folder that is deleted again. Of every stage
two times are printed: by the clock on the wall, and of all threads of the process on the CPU, which
tells on a machine that others use, too. With ``--functions N`` a second run follows under
Python's profiler, and the N costliest functions of each stage are printed; compiled loops and
PyTorch's operators appear under the function that calls them or their own names.
"""

import argparse
import cProfile
import pstats
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from geogs.application.machine import compiled_kernels
from geogs.application.result import Result
from geogs.application.results import write_results
from geogs.application.shutter import with_shutter_found
from geogs.cli.options import parse_options
from geogs.config import Config
from geogs.io.sources.sniff import open_source
from geogs.slam import Slam
from geogs.stopwatch import Stopwatch
from geogs.threads import on_one_torch_thread, worker_count

STARTS = {
    "geogs run --help": "from geogs.cli.main import main; main(['run', '--help'])",
    "import torch": "import torch",
    "imports of geogs run": "import geogs.application.run, geogs.application.terminal",
}
"""What a process of its own does before it ends."""
LEAST_SHARE = 0.01
"""Of a stage's time, below which a function is not printed."""


class StageMeter(Stopwatch):
    """A stopwatch that counts the seconds of the CPU as well, and can profile each stage."""

    def __init__(self, profiles: bool) -> None:
        super().__init__()
        self.processor: dict[str, float] = {}
        self.profiles: dict[str, cProfile.Profile] = {}
        self._with_profiles = profiles
        self._is_inside = False

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        if self._is_inside:
            yield
            return
        profile = self.profiles.setdefault(stage, cProfile.Profile(time.thread_time))
        self._is_inside, start = True, time.process_time()
        try:
            with super().__call__(stage):
                if self._with_profiles:
                    profile.enable()
                yield
        finally:
            profile.disable()
            self._is_inside = False
            spent = time.process_time() - start
            self.processor[stage] = self.processor.get(stage, 0.0) + spent


def start_up(code: str) -> tuple[float, float]:
    """Seconds of the wall and of the CPU that a new interpreter needs for some code."""
    measure = (
        f"import sys, time; out, sys.stdout = sys.stdout, sys.stderr\n{code}\n"
        "print(time.process_time(), file=out)"
    )
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", measure], check=True, capture_output=True, text=True
    )
    return time.perf_counter() - start, float(done.stdout)


@on_one_torch_thread
def measured_run(
    source: Path, config: Config, device: str, profiles: bool
) -> tuple[StageMeter, float, int]:
    """A run from opening to report; its meter, CPU seconds to the first tracked frame, frames."""
    meter, start, first = StageMeter(profiles), time.process_time(), float("nan")
    with meter("opening"):
        compiled_kernels(torch.device(device))
        stream = open_source((source,), config.input)
    with meter("shutter"):
        stream = with_shutter_found(stream)
    with meter("making the system"):
        slam = Slam(stream.camera, config, device)
    slam.stopwatch = meter
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
        result = Result(slam, stream)
        inner = Stopwatch()  # what is made for the files is no stage of its own here
        slam.stopwatch = inner
        write_results(folder, result)
        for name, seconds in inner.seconds.items():
            print(f"  of the files, {name}: {seconds:.2f} s")
    return meter, first, slam.frames


def print_functions(meter: StageMeter, count: int, show: Callable[[str], None] = print) -> None:
    """The costliest functions of each stage by their own seconds, compiled ones included."""
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
    config = parse_options(Config, rest, "run")
    for name, code in STARTS.items():
        wall, processor = min(start_up(code) for _ in range(3))
        print(f"{name:<26} {wall:7.2f} s wall {processor:7.2f} s CPU")
    meter, first, frames = measured_run(given.source, config, given.device, profiles=False)
    print(f"\n{frames} frames on {given.device}, {worker_count()} threads of the kernels;")
    print(f"first frame tracked {first:.2f} s of CPU after the imports\n")
    total, total_cpu = meter.total, sum(meter.processor.values())
    for stage, seconds in sorted(meter.seconds.items(), key=lambda item: -item[1]):
        share = meter.processor[stage] / total_cpu
        print(f"{stage:<26} {seconds:7.2f} s wall {meter.processor[stage]:7.2f} s CPU {share:6.1%}")
    print(f"{'total':<26} {total:7.2f} s wall {total_cpu:7.2f} s CPU")
    if given.functions:
        meter, _, _ = measured_run(given.source, config, given.device, profiles=True)
        print_functions(meter, given.functions)


if __name__ == "__main__":
    main()
