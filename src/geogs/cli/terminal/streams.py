"""Standard streams that never end a command: closed, full, of another encoding, or gone."""

import io
import os
import sys
from contextlib import suppress
from typing import TextIO


def make_unbreakable() -> None:
    """Replace the streams of the process by ones that drop what can no longer be written.

    Numbers 0 to 2 that are closed are opened to nowhere first, so that no file of a result gets
    one of them, and with it what some library prints. Characters that a terminal does not know are
    written as escapes. Streams that somebody else has put in place stay.
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
    """Writes to a descriptor; what that does not take is lost."""

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
    # Of its own: what decoders print is caught by leading the number elsewhere meanwhile.
    buffer = io.BufferedWriter(_Dropping(os.dup(number)))
    return io.TextIOWrapper(buffer, encoding, "backslashreplace", line_buffering=True)
