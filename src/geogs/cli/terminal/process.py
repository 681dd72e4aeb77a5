"""Changes that the ``geogs`` command makes to its own process, with reasons.

A program that imports geogs keeps its own state: none of this is done for it.
"""

import atexit
import gc
import io
import os
import signal
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from types import FrameType
from typing import TextIO

from geogs.application.interrupt import handled_signals, interrupt
from geogs.guard.terminal_text import escape_records


def take_over() -> None:
    """Make the process ready for a command, before anything heavy is imported.

    NumPy's BLAS gets one thread, since our own threads use the cores. Its threads spin while they
    wait for each other, for small matrices: the search for a readout took eight times as long on
    64 cores as on 16, and on two a third longer than with one thread.

    SIGTERM, of systems and schedulers, and SIGHUP act like Ctrl-C: results so far are kept.
    Streams that are closed, full or gone end no command.
    """
    _handle_signals(interrupt)
    _leave_imports_alone()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    make_unbreakable()


def _leave_imports_alone() -> None:
    """Limit garbage collection to objects made after the imports.

    Modules stay; scanning them repeatedly takes a sixth of the import time, and later delays some
    frames.
    """
    usual = gc.get_threshold()

    def imported(phase: str, info: dict[str, int]) -> None:
        if phase == "stop":
            gc.callbacks.remove(imported)
            gc.freeze()
            gc.set_threshold(*usual)

    gc.callbacks.append(imported)
    # Number of objects above that of a run's imports: 330,000, with SciPy and Numba 450,000.
    gc.set_threshold(500_000, *usual[1:])


def show_warnings() -> None:
    """Show the library's warnings on the standard error, one line each.

    A log that can no longer be written, as on a full disk, is ignored silently.
    """
    import logging

    logging.raiseExceptions = False
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("warning: %(message)s"))
    handler.setLevel(logging.WARNING)
    escape_records(handler)
    log = logging.getLogger("geogs")
    others = (other for other in log.handlers if not isinstance(other, logging.StreamHandler))
    log.handlers[:] = [handler, *others]
    log.propagate = False


def leave(code: int) -> None:
    """End the process at once if PyTorch was loaded, after its exit functions.

    Freeing modules and a GPU's memory, which the system takes back anyway, takes a second. Signals
    end it at once, without a message.
    """
    _handle_signals(signal.SIG_DFL)
    if "torch" in sys.modules:
        atexit._run_exitfuncs()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _handle_signals(handler: Callable[[int, FrameType | None], None] | signal.Handlers) -> None:
    if threading.current_thread() is threading.main_thread():
        for number in handled_signals():
            signal.signal(number, handler)


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
