"""pycolmap, loaded on demand and without its output."""

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

from geogs.errors import InputError
from geogs.extras import install_command


def load_colmap() -> Any:
    """Load the module ``pycolmap``; its log is not printed.

    Raises:
        InputError: it is not installed, or cannot be loaded.
    """
    is_first = "pycolmap" not in sys.modules
    try:
        with _request_to_end_kept() if is_first else nullcontext():
            import pycolmap
    except ImportError as error:
        raise InputError(
            f"Structure from motion needs pycolmap ({error}): {install_command('photos')}"
        ) from error
    # Failures are raised as exceptions; its lines would disturb the progress line.
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL)
    return pycolmap


@contextmanager
def _request_to_end_kept() -> Iterator[None]:
    """Restore the handler of SIGTERM, which pycolmap's import replaces by one that prints a stack.

    The signal is blocked meanwhile, except in other threads, for some hundredths of a second."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.getsignal(signal.SIGTERM) or signal.SIG_DFL
    waiting = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
        signal.pthread_sigmask(signal.SIG_SETMASK, waiting)
