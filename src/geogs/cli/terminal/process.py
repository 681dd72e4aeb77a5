"""Changes that the ``geogs`` command makes to its own process, with reasons.

A program that imports geogs keeps its own state: none of this is done for it.
"""

import atexit
import gc
import os
import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType

from geogs.application.interrupt import handled_signals, interrupt
from geogs.cli.terminal.streams import make_unbreakable

_IMPORTED = 500_000
"""Number of objects above that of a run's imports: 330,000, with SciPy and Numba 450,000."""


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
    gc.set_threshold(_IMPORTED, *usual[1:])


def show_warnings() -> None:
    """Show the library's warnings on the standard error, one line each.

    A log that can no longer be written, as on a full disk, is ignored silently.
    """
    import logging

    logging.raiseExceptions = False
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("warning: %(message)s"))
    handler.setLevel(logging.WARNING)
    log = logging.getLogger("geogs")
    log.handlers[:] = [handler]
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
