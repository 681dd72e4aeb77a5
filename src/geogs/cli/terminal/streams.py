"""Standard streams that never end a command, even if closed, full, gone, or wrongly encoded."""

import io
import os
import sys
from contextlib import suppress
from typing import TextIO


def make_unbreakable() -> None:
    """Replace the streams of the process by ones that drop output that cannot be written.

    Closed descriptors 0 to 2 are opened to the null device first, so that no file of a result gets
    one of them, and with it the output of libraries. Characters unknown to a terminal are written
    as escapes. Streams that were replaced already stay.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            with suppress(OSError):
                os.open(os.devnull, os.O_RDWR)  # gets the smallest number that is free
    if sys.stdout is sys.__stdout__:
        sys.stdout = _unbreakable(1, sys.stdout)
    if sys.stderr is sys.__stderr__:
        sys.stderr = _unbreakable(2, sys.stderr)


class _Dropping(io.RawIOBase):
    """Writes to a descriptor; output that fails is lost."""

    def __init__(self, number: int) -> None:
        self._number = number

    def writable(self) -> bool:
        return True

    def fileno(self) -> int:
        return self._number

    def isatty(self) -> bool:
        return os.isatty(self._number)

    def write(self, data: object) -> int:
        view = memoryview(data).cast("B")  # type: ignore[arg-type]
        try:
            return os.write(self._number, view)
        except OSError:
            return len(view)


def _unbreakable(number: int, before: TextIO | None) -> TextIO:
    encoding = getattr(before, "encoding", None) or "utf-8"
    with suppress(OSError, ValueError):
        if before is not None:
            before.flush()
    # A duplicate: decoder noise is caught by redirecting the original number meanwhile.
    buffer = io.BufferedWriter(_Dropping(os.dup(number)))
    return io.TextIOWrapper(buffer, encoding, "backslashreplace", line_buffering=True)
