"""Faults of the disk below a folder: it is full from the n-th write on, or the process is killed at
the n-th change of anything."""

import errno
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from geogs.application.results.output_folder import LOCK
from geogs.errors import OutputError

_WRITES = ("open", "os.mkdir", "os.fsync")
_CHANGES = (*_WRITES, "os.rename", "os.remove", "os.rmdir")
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT


class Killed(BaseException):
    """The process is no more: what it would still do is not done either."""


@dataclass
class Fault:
    """What goes wrong, from when on."""

    folder: Path
    kinds: tuple[str, ...]
    error: Callable[[], BaseException]
    left: int

    def happens_at(self, event: str, arguments: tuple[object, ...]) -> bool:
        """Whether it goes wrong there."""
        if event not in self.kinds or not self._is_below(event, arguments):
            return False
        self.left -= 1
        return self.left < 0

    def _is_below(self, event: str, arguments: tuple[object, ...]) -> bool:
        if event == "open" and not (isinstance(arguments[2], int) and arguments[2] & _WRITING):
            return False
        is_path = isinstance(arguments[0], str | os.PathLike)
        path = os.path.realpath(arguments[0]) if is_path else ""  # some lead by a handle
        by_handle = event not in ("open", "os.fsync") and arguments[-1] != -1
        return by_handle or event == "os.fsync" or path.startswith(str(self.folder))


_present: list[Fault] = []


def _watch(event: str, arguments: tuple[object, ...]) -> None:
    for fault in _present:
        if fault.happens_at(event, arguments):
            raise fault.error()


sys.addaudithook(_watch)


@contextmanager
def _fault(
    folder: Path, kinds: tuple[str, ...], error: Callable[[], BaseException], n: int
) -> Iterator[None]:
    fault, fsync = Fault(folder, kinds, error, n), os.fsync

    def watched(handle: int) -> None:
        _watch("os.fsync", (handle,))
        fsync(handle)

    _present.append(fault)
    os.fsync = watched
    try:
        yield
    finally:
        os.fsync = fsync
        _present.remove(fault)


def full_disk(folder: Path, n: int) -> AbstractContextManager[None]:
    """Inside, the n-th write below a folder and all after it find the disk full; n is from 0."""
    return _fault(folder, _WRITES, lambda: OSError(errno.ENOSPC, "No space left on device"), n)


def kill(folder: Path, n: int) -> AbstractContextManager[None]:
    """Inside, the n-th change of files below a folder and all after it are not done any more."""
    return _fault(folder, _CHANGES, Killed, n)


def contents(folder: Path) -> dict[str, bytes]:
    """Bytes of all files, by name; but for the lock, which a killed process leaves."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files if path.name != LOCK}


def every_fault(
    fault: Callable[[Path, int], AbstractContextManager[None]],
    folder: Path,
    work: Callable[[], object],
    step: int = 1,
) -> Iterator[None]:
    """Do some work on a folder again and again, each time with the fault so many steps later.

    Yields after each time that did not come to its end.
    """
    for n in range(0, 1000 * step, step):
        try:
            with fault(folder, n):
                work()
        except Killed:
            yield
        except OutputError as error:
            if "No space left on device" not in str(error):
                raise
            yield
        else:
            return
    pytest.fail("it never came to its end")
