"""Kernels for the CPU, compiled once on a machine, by other processes while the first images come.

``python -m geogs.application.machine.compilation`` compiles them at once. Numba keeps them where
:mod:`geogs.kernel_folder` says; files beside them tell of what they are.
"""

import contextlib
import gc
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

import torch

from geogs.gpu.kernel_source import PACKAGE
from geogs.kernel_folder import kernel_folder
from geogs.stopwatch import StageProgress

PARTS = {"search": 26, "train": 14, "mesh": 13}
"""What is compiled side by side, and how many kernels that are called from Python; what is needed
first goes first."""
KERNELS_OF_SEARCH = PARTS["search"]
KERNELS_OF_MAP = KERNELS_OF_SEARCH + PARTS["train"]
KERNELS = sum(PARTS.values())
ON_GPU = {"planes": 4, "turn": 3, "lens": 3}
"""The same where a GPU does the rest; what takes longest goes first."""
POSED_ON_GPU = {"look": 5, "planes": 4}
"""The same where poses are known, too."""
_NICENESS = 5
"""Added to the niceness of each part over what goes before it, images first of all."""
_OBJECTS = 100_000
"""New objects after which Python looks for garbage; a compiler makes many that stay."""
_SOURCES = ("**/*_kernels.py", "splat/cpu/*.py")


class Compilation:
    """What other processes compile, each a part; nothing where all is there."""

    def __init__(self, parts: "Sequence[tuple[subprocess.Popen[str], int]]" = ()) -> None:
        """Processes in the order in which their kernels are needed, and how many each compiles."""
        self._processes = [process for process, _ in parts]
        self._kernels = [kernels for _, kernels in parts]
        self._done = [0] * len(parts)

    @property
    def is_working(self) -> bool:
        """Whether something has still to be compiled."""
        return any(process.poll() is None for process in self._processes)

    def wait(self, report: StageProgress, first: int | None = None) -> float:
        """Until all is compiled, or the ``first`` so many; how many seconds that took from now on.

        What ``report`` raises ends it early; what has failed is compiled when it is used.
        """
        start = time.perf_counter()
        needed = sum(self._kernels) if first is None else first
        left = needed
        for part, process in enumerate(self._processes):
            assert process.stdout is not None
            wanted = min(left, self._kernels[part])
            left -= wanted
            while self._done[part] < wanted:
                is_working = process.poll() is None
                if not process.stdout.readline():
                    break
                self._done[part] += 1
                if is_working:
                    report("compiling, once", min(sum(self._done) / needed, 1.0))
        return time.perf_counter() - start

    def stop(self) -> None:
        """End the processes that still work."""
        for process in self._processes:
            process.terminate()
        for process in self._processes:
            process.communicate()


@contextmanager
def compiling(device: torch.device, knows_poses: bool = False) -> Iterator[Compilation]:
    """Inside, what a command needs of the CPU is compiled beside it, if it is not."""
    on_gpu = POSED_ON_GPU if knows_poses else ON_GPU
    parts = PARTS if device.type == "cpu" else on_gpu
    if is_compiled(parts) or not sys.executable:
        yield Compilation()
        return
    none, pipe = subprocess.DEVNULL, subprocess.PIPE
    begun = []
    for part, kernels in parts.items():
        command = [sys.executable, "-m", __name__, part]
        with contextlib.suppress(OSError):  # no memory, no more processes: compiled when it is used
            process = subprocess.Popen(command, stdin=none, stdout=pipe, stderr=none, text=True)
            begun.append((process, kernels))
    compilation = Compilation(begun)
    try:
        yield compilation
    finally:
        compilation.stop()


def is_compiled(parts: Iterable[str] = PARTS) -> bool:
    """Whether the kernels that are there were made by this version for this processor."""
    with contextlib.suppress(OSError):
        return all(_record(part).read_text() == _made_of() for part in parts)
    return False


def compile_now(
    parts: Iterable[str] = PARTS, report: Callable[[str], None] = lambda name: None
) -> int:
    """Compile what is not; ``report`` gets the name of each. Returns how many kernels that were."""
    from numba.core import event

    from geogs.application.machine.rehearsal import rehearse

    compiled: list[str] = []
    depth = 0

    class Listener(event.Listener):
        """Kernels that others call are part of these; one at a time is compiled."""

        def on_start(self, event: event.Event) -> None:
            nonlocal depth
            depth += 1

        def on_end(self, event: event.Event) -> None:
            nonlocal depth
            depth -= 1
            if not depth:
                compiled.append(event.data["dispatcher"].py_func.__name__)
                report(compiled[-1])

    with event.install_listener("numba:compile", Listener()):
        for part in parts:
            rehearse(part)
    with contextlib.suppress(OSError):
        for record in map(_record, parts):
            record.parent.mkdir(parents=True, exist_ok=True)
            record.write_text(_made_of())
    return len(compiled)


def _record(part: str) -> Path:
    return kernel_folder() / f"geogs-compiled-{part}.txt"


def _made_of() -> str:
    """What numba compiles anew where it changes."""
    from llvmlite.binding import get_host_cpu_name

    files = sorted(path for pattern in _SOURCES for path in PACKAGE.glob(pattern))
    sources = [f"{f.relative_to(PACKAGE)} {f.stat().st_mtime_ns}" for f in files]
    made = [sys.version, version("numba"), get_host_cpu_name(), str(PACKAGE), *sources]
    return "\n".join(made)


def main(arguments: list[str]) -> None:
    """Compile all, or the parts that are named, with a line for each kernel."""
    parts = arguments or [*PARTS]
    os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")  # nobody reads them
    gc.freeze()
    gc.set_threshold(_OBJECTS)
    with contextlib.suppress(AttributeError, OSError):
        os.nice(_NICENESS * (1 + [*(ON_GPU | POSED_ON_GPU | PARTS)].index(parts[0])))
    if not is_compiled(parts):
        compile_now(parts, lambda name: print(name, flush=True))


if __name__ == "__main__":
    main(sys.argv[1:])
