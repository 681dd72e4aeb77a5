"""pycolmap, loaded when it is needed and kept quiet."""

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

from geogs.errors import InputError


def load_colmap() -> Any:
    """The module ``pycolmap``; what it has to say of its work is not printed.

    Raises:
        InputError: it is not installed, or cannot be loaded.
    """
    is_first = "pycolmap" not in sys.modules
    try:
        with _request_to_end_kept() if is_first else nullcontext():
            import pycolmap
    except ImportError as error:
        raise InputError(
            "Finding the poses of photographs needs pycolmap; pip install 'geogs[photos]' brings "
            f"it ({error})."
        ) from error
    # Failures come back as exceptions; its lines would tear the progress line apart.
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL)
    return pycolmap


@contextmanager
def _request_to_end_kept() -> Iterator[None]:
    """Its import makes a request to end print a stack: what was there before is put back, and a
    request that comes meanwhile waits; but for one that another thread takes in the hundredths of a
    second until then."""
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
