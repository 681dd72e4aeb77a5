"""Kernels for the CPU, compiled once per machine, by other processes while a run starts.

``python -m geogs.application.machine.compilation`` compiles them at once. Numba keeps them where
:mod:`geogs.guard.kernel_folder` says; files beside them record the versions they were made of.
"""

import contextlib
import gc
import os
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

import torch

from geogs.gpu.kernel_source import PACKAGE
from geogs.guard.kernel_folder import kernel_folder
from geogs.stopwatch import StageProgress

PARTS = "search", "train", "mesh"
"""Parts that are compiled in parallel, in the order in which they are needed."""
ON_GPU = "planes", "turn", "lens"
"""Parts for a run on a GPU, those that take longest first."""
POSED_ON_GPU = "look", "planes"
"""Parts for known poses on a GPU."""
_SOURCES = ("**/*_kernels.py", "splat/cpu/*.py")


class Compilation:
    """Compilation in other processes, one for each part; none where all is compiled."""

    def __init__(self, parts: "Mapping[str, subprocess.Popen[str]] | None" = None) -> None:
        """``parts`` are processes by part, in the order in which these are needed."""
        self._processes = parts or {}

    @property
    def is_working(self) -> bool:
        """Whether a process still compiles."""
        return any(process.poll() is None for process in self._processes.values())

    def wait(self, report: StageProgress, last: str | None = None) -> float:
        """Wait until all is compiled, or, if ``last`` is one of the parts, those up to it. Returns
        the seconds waited.

        An exception of ``report`` ends it early; failed parts are compiled when they are used.
        """
        start = time.perf_counter()
        names = [*self._processes]
        needed = names[: names.index(last) + 1] if last in names else names
        for done, part in enumerate(needed):
            while self._processes[part].poll() is None:
                report("compiling, once", done / len(needed))
                time.sleep(0.05)
        return time.perf_counter() - start

    def stop(self) -> None:
        """End the processes that still work."""
        for process in self._processes.values():
            process.terminate()
        for process in self._processes.values():
            process.wait()


@contextmanager
def compiling(device: torch.device, knows_poses: bool = False) -> Iterator[Compilation]:
    """Compile the CPU kernels of a command in the background of the block, where missing."""
    on_gpu = POSED_ON_GPU if knows_poses else ON_GPU
    parts = PARTS if device.type == "cpu" else on_gpu
    if is_compiled(parts) or not sys.executable:
        yield Compilation()
        return
    none = subprocess.DEVNULL
    begun = {}
    for part in parts:
        command = [sys.executable, "-m", __name__, part]
        with contextlib.suppress(OSError):  # no memory, no more processes: compiled when it is used
            begun[part] = subprocess.Popen(command, stdin=none, stdout=none, stderr=none, text=True)
    compilation = Compilation(begun)
    try:
        yield compilation
    finally:
        compilation.stop()


def is_compiled(parts: Iterable[str] = PARTS) -> bool:
    """Whether the stored kernels are complete, and of this version and processor."""
    with contextlib.suppress(OSError):
        return all(_record(part).read_text() == _made_of() for part in parts)
    return False


def compile_now(parts: Iterable[str] = PARTS) -> None:
    """Compile missing kernels, and write a record."""
    from geogs.application.machine.rehearsal import rehearse

    for part in parts:
        rehearse(part)
    with contextlib.suppress(OSError):
        for record in map(_record, parts):
            record.parent.mkdir(parents=True, exist_ok=True)
            record.write_text(_made_of())


def _record(part: str) -> Path:
    return kernel_folder() / f"geogs-compiled-{part}.txt"


def _made_of() -> str:
    """Versions, processor and sources; numba recompiles where these change."""
    from llvmlite.binding import get_host_cpu_name

    files = sorted(path for pattern in _SOURCES for path in PACKAGE.glob(pattern))
    sources = [f"{f.relative_to(PACKAGE)} {f.stat().st_mtime_ns}" for f in files]
    made = [sys.version, version("numba"), get_host_cpu_name(), str(PACKAGE), *sources]
    return "\n".join(made)


def main(arguments: list[str]) -> None:
    """Compile all parts, or the named ones."""
    parts = arguments or [*PARTS]
    os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")  # messages are not shown
    gc.freeze()
    # Threshold of garbage collection, in new objects; a compiler makes many that stay.
    gc.set_threshold(100_000)
    with contextlib.suppress(AttributeError, OSError):
        # Increment of niceness from each part to the next; the run itself comes first.
        os.nice(5 * (1 + [*POSED_ON_GPU, *ON_GPU, *PARTS].index(parts[0])))
    if not is_compiled(parts):
        compile_now(parts)


if __name__ == "__main__":
    main(sys.argv[1:])
