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
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

import torch

from geogs.gpu.kernel_source import PACKAGE
from geogs.kernel_folder import kernel_folder
from geogs.stopwatch import StageProgress

PARTS = "search", "train", "mesh"
"""What is compiled side by side; what is needed first goes first."""
ON_GPU = "planes", "turn", "lens"
"""The same where a GPU does the rest; what takes longest goes first."""
POSED_ON_GPU = "look", "planes"
"""The same where poses are known, too."""
_NICENESS = 5
"""Added to the niceness of each part over what goes before it, images first of all."""
_POLL_SECONDS = 0.05
_OBJECTS = 100_000
"""New objects after which Python looks for garbage; a compiler makes many that stay."""
_SOURCES = ("**/*_kernels.py", "splat/cpu/*.py")


class Compilation:
    """What other processes compile, each a part; nothing where all is there."""

    def __init__(self, parts: "Mapping[str, subprocess.Popen[str]] | None" = None) -> None:
        """Processes by their parts, in the order in which these are needed."""
        self._processes = parts or {}

    @property
    def is_working(self) -> bool:
        """Whether something has still to be compiled."""
        return any(process.poll() is None for process in self._processes.values())

    def wait(self, report: StageProgress, last: str | None = None) -> float:
        """Until all is compiled, or the parts up to the ``last`` that is needed, if that is among
        them; how many seconds that took from now on.

        What ``report`` raises ends it early; what has failed is compiled when it is used.
        """
        start = time.perf_counter()
        names = [*self._processes]
        needed = names[: names.index(last) + 1] if last in names else names
        for done, part in enumerate(needed):
            while self._processes[part].poll() is None:
                report("compiling, once", done / len(needed))
                time.sleep(_POLL_SECONDS)
        return time.perf_counter() - start

    def stop(self) -> None:
        """End the processes that still work."""
        for process in self._processes.values():
            process.terminate()
        for process in self._processes.values():
            process.wait()


@contextmanager
def compiling(device: torch.device, knows_poses: bool = False) -> Iterator[Compilation]:
    """Inside, what a command needs of the CPU is compiled beside it, if it is not."""
    on_gpu = POSED_ON_GPU if knows_poses else ON_GPU
    parts = PARTS if device.type == "cpu" else on_gpu
    if is_compiled(parts) or not sys.executable:
        yield Compilation()
        return
    none, begun = subprocess.DEVNULL, {}
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
    """Whether the kernels that are there were made by this version for this processor."""
    with contextlib.suppress(OSError):
        return all(_record(part).read_text() == _made_of() for part in parts)
    return False


def compile_now(parts: Iterable[str] = PARTS) -> None:
    """Compile what is not, and keep a record of it."""
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
    """What numba compiles anew where it changes."""
    from llvmlite.binding import get_host_cpu_name

    files = sorted(path for pattern in _SOURCES for path in PACKAGE.glob(pattern))
    sources = [f"{f.relative_to(PACKAGE)} {f.stat().st_mtime_ns}" for f in files]
    made = [sys.version, version("numba"), get_host_cpu_name(), str(PACKAGE), *sources]
    return "\n".join(made)


def main(arguments: list[str]) -> None:
    """Compile all, or the parts that are named."""
    parts = arguments or [*PARTS]
    os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")  # nobody reads them
    gc.freeze()
    gc.set_threshold(_OBJECTS)
    with contextlib.suppress(AttributeError, OSError):
        os.nice(_NICENESS * (1 + [*POSED_ON_GPU, *ON_GPU, *PARTS].index(parts[0])))
    if not is_compiled(parts):
        compile_now(parts)


if __name__ == "__main__":
    main(sys.argv[1:])
