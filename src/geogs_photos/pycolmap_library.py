"""pycolmap, loaded when it is needed and kept quiet."""

import signal
import sys
import threading
from typing import Any

from geogs.errors import InputError


def load_colmap() -> Any:
    """The module ``pycolmap``; what it has to say of its work is not printed.

    Raises:
        InputError: it is not installed, or cannot be loaded.
    """
    is_first = "pycolmap" not in sys.modules
    try:
        import pycolmap
    except ImportError as error:
        raise InputError(
            "Finding the poses of photographs needs pycolmap; pip install 'geogs[photos]' brings "
            f"it ({error})."
        ) from error
    # Failures come back as exceptions; its lines would tear the progress line apart.
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL)
    if is_first and threading.current_thread() is threading.main_thread():
        # It makes a request to end print a stack, so what was there before is put back.
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)
    return pycolmap
