"""Catch messages of picture decoders, which are C libraries, on the standard error."""

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

_WORDS = (
    "jpeg", "png", "tiff", "webp", "opencv", " warn:", " error:", "bmp", "exif", "iccp", "cv::",
)  # fmt: skip
"""Words that identify lines of decoders, in lower case."""
_PIPE_SIZE = 1 << 20


@contextmanager
def decoder_noise(alone: bool = True) -> Iterator[list[str]]:
    """Catch lines of decoders on the standard error in a block; afterwards the list has them.

    Lines of others go on to the standard error, at the end of a block at the latest. A block that
    is not ``alone`` may also get lines of decoders in other threads.
    """
    lines: list[str] = []
    before = _STANDARD_ERROR.enter(alone)
    try:
        yield lines
    finally:
        lines += _STANDARD_ERROR.leave(before)


class _StandardError:
    """Standard error of the process, redirected into a pipe while any thread decodes."""

    def __init__(self) -> None:
        self._turn = threading.Condition()
        self._inside = self._waiting = 0
        self._is_one_alone = False
        self._kept: int | None = None
        """The standard error itself while it is redirected; else none."""
        self._pipe = -1
        self._caught: list[str] = []

    def enter(self, alone: bool) -> int:
        """Begin a block, after any that is alone. Returns the number of lines caught before."""
        with self._turn:
            if alone:
                self._waiting += 1
                try:
                    self._turn.wait_for(lambda: not self._inside)
                finally:  # an interrupted wait blocks no other thread
                    self._waiting -= 1
                self._is_one_alone = True
            else:
                self._turn.wait_for(lambda: not self._is_one_alone and not self._waiting)
            self._inside += 1
            if self._inside == 1:
                self._begin()
            self._read()
            return len(self._caught)

    def leave(self, before: int) -> list[str]:
        """End a block. Returns the lines that were caught since ``before``."""
        with self._turn:
            self._read()
            lines = self._caught[before:]
            self._inside -= 1
            if not self._inside:
                self._end()
            self._turn.notify_all()
        return lines

    def _begin(self) -> None:
        try:
            there, here = os.pipe()
        except OSError:  # too many files are open
            return
        try:
            self._kept = os.dup(2)
        except OSError:  # there is no standard error
            os.close(there)
            os.close(here)
            return
        os.set_blocking(there, False)
        os.set_blocking(here, False)  # lines that do not fit are dropped; nothing waits
        os.dup2(here, 2)
        os.close(here)
        self._pipe = there

    def _read(self) -> None:
        """Keep lines of decoders, and give those of others to the standard error."""
        if self._kept is None:
            return
        try:
            caught = os.read(self._pipe, _PIPE_SIZE)
        except BlockingIOError:
            return
        for line in caught.splitlines(keepends=True):
            text = line.decode("utf-8", "replace").strip()
            if any(word in text.lower() for word in _WORDS):
                self._caught.append(text)
            elif text:
                with suppress(OSError):
                    os.write(self._kept, line)

    def _end(self) -> None:
        self._is_one_alone = False
        self._caught.clear()
        if self._kept is not None:
            os.dup2(self._kept, 2)
            os.close(self._kept)
            os.close(self._pipe)
            self._kept = None


_STANDARD_ERROR = _StandardError()
