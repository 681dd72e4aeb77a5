"""Kernels for the CPU, compiled once on a machine, by another process while the first images come.

``python -m geogs.application.machine.compilation`` compiles them at once. Numba keeps them where
:mod:`geogs.kernel_folder` says; a file beside them tells of what they are.
"""

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

import torch

from geogs.gpu.kernel_source import PACKAGE
from geogs.kernel_folder import kernel_folder
from geogs.stopwatch import StageProgress

OF_SEARCH, OF_MAP, KERNELS = 8, 25, 34
"""How many a rehearsal compiles, those counted that are called from Python: first what depths are
searched by, up to what a map needs, up to a mesh, for which a GPU needs them, too."""
_POLITELY = 5
"""Niceness of the other process: images go first."""
_SOURCES = ("**/*_kernels.py", "splat/cpu/*.py")


class Compilation:
    """What another process compiles; nothing where all is there."""

    def __init__(self, process: "subprocess.Popen[str] | None" = None, kernels: int = 0) -> None:
        self._process, self._kernels, self._done = process, kernels, 0

    @property
    def is_working(self) -> bool:
        """Whether something has still to be compiled."""
        return self._process is not None and self._process.poll() is None

    def wait(self, report: StageProgress, first: int | None = None) -> float:
        """Until all is compiled, or the ``first`` so many; how many seconds that took from now on.

        What ``report`` raises ends it early; what has failed is compiled when it is used.
        """
        start, needed = time.perf_counter(), self._kernels if first is None else first
        while self._process is not None and self._done < needed:
            assert self._process.stdout is not None
            is_working = self.is_working
            if not self._process.stdout.readline():
                break
            self._done += 1
            if is_working:
                report("compiling, once", min(self._done / needed, 1.0))
        return time.perf_counter() - start

    def stop(self) -> None:
        """End the process if it still works."""
        if self._process is not None:
            self._process.terminate()
            self._process.communicate()


@contextmanager
def compiling(device: torch.device) -> Iterator[Compilation]:
    """Inside, what a command on a device needs for the CPU is compiled beside it, if it is not."""
    with_map = device.type == "cpu"
    if is_compiled(with_map) or not sys.executable:
        yield Compilation()
        return
    command = [sys.executable, "-m", __name__, *(() if with_map else ("mesh",))]
    none, pipe = subprocess.DEVNULL, subprocess.PIPE
    try:
        process = subprocess.Popen(command, stdin=none, stdout=pipe, stderr=none, text=True)
    except OSError:  # no memory, no more processes: compiled when it is used
        yield Compilation()
        return
    compilation = Compilation(process, KERNELS if with_map else KERNELS - OF_MAP)
    try:
        yield compilation
    finally:
        compilation.stop()


def is_compiled(with_map: bool = True) -> bool:
    """Whether the kernels that are there were made by this version for this processor."""
    with contextlib.suppress(OSError):
        return _record(with_map).read_text() == _made_of()
    return False


def compile_now(with_map: bool = True, report: Callable[[str], None] = lambda name: None) -> int:
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
        rehearse(with_map)
    with contextlib.suppress(OSError):
        for record in {_record(with_map), _record(False)}:
            record.parent.mkdir(parents=True, exist_ok=True)
            record.write_text(_made_of())
    return len(compiled)


def _record(with_map: bool) -> Path:
    return kernel_folder() / f"geogs-compiled-{'all' if with_map else 'mesh'}.txt"


def _made_of() -> str:
    """What numba compiles anew where it changes."""
    from llvmlite.binding import get_host_cpu_name

    files = sorted(path for pattern in _SOURCES for path in PACKAGE.glob(pattern))
    sources = [f"{f.relative_to(PACKAGE)} {f.stat().st_mtime_ns}" for f in files]
    made = [sys.version, version("numba"), get_host_cpu_name(), str(PACKAGE), *sources]
    return "\n".join(made)


def main(arguments: list[str]) -> None:
    """Compile all, or what a mesh needs, with a line for each kernel."""
    with contextlib.suppress(AttributeError, OSError):
        os.nice(_POLITELY)
    if not is_compiled(with_map := "mesh" not in arguments):
        compile_now(with_map, lambda name: print(name, flush=True))


if __name__ == "__main__":
    main(sys.argv[1:])
