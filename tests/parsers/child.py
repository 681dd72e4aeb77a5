"""A process of its own that reads damaged files: what ends it, holds it or floods it is found."""

import logging
import resource
import traceback
from collections.abc import Callable
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from types import TracebackType

from parsers import parsers
from parsers.base import Parser
from parsers.reading import SECONDS, read

Make = Callable[[], dict[str, Parser]]


class Child:
    """Reads with the parsers that ``make`` gives; starts again after a finding."""

    def __init__(
        self, make: Make = parsers, seconds: float = 11 * SECONDS, memory: int = 2 << 30
    ) -> None:
        """Reading may take so many seconds, and so many bytes with all that is imported."""
        self._work, self._seconds = (make, memory), seconds
        self._pipe: Connection | None = None

    def read(self, name: str, folder: Path) -> None:
        """Read an example as :func:`parsers.reading.read` does.

        Raises:
            AssertionError: of a traceback, a crash, too long a time or too much memory.
        """
        pipe = self._pipe or self._start()
        try:
            pipe.send((name, folder))
            found = pipe.recv() if pipe.poll(self._seconds) else f"{name} hangs"
        except (EOFError, ConnectionError):
            self._process.join()
            found = f"{name} ended the process with {self._process.exitcode}"
        if found:
            self.close()
            raise AssertionError(found)

    def _start(self) -> Connection:
        context = get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, *self._work), daemon=True)
        self._process.start()
        theirs.close()
        self._pipe.recv()  # it has imported what it needs
        return self._pipe

    def close(self) -> None:
        """End the process, if there is one."""
        if self._pipe is not None:
            self._process.kill()
            self._process.join()
            self._pipe.close()
            self._pipe = None

    def __enter__(self) -> "Child":
        return self

    def __exit__(
        self, kind: type | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _serve(pipe: Connection, make: Make, memory: int) -> None:
    logging.disable()
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (3 * memory, 3 * memory))
    known = make()
    pipe.send("")
    while True:
        try:
            name, folder = pipe.recv()
        except EOFError:
            return
        try:
            read(known[name], folder)
            taken = _most_memory()
            pipe.send("" if taken < memory else f"{name} took {taken >> 20} MiB")
        except BaseException:  # a hang is one
            pipe.send(traceback.format_exc())


def _most_memory() -> int:
    """Bytes that this process has held at most; of ``getrusage`` it would be those of the one that
    started it, too."""
    status = Path("/proc/self/status")
    if not status.exists():
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10
    line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM:"))
    return int(line.split()[1]) << 10
