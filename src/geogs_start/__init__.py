"""The ``geogs`` command, before anything of geogs is imported."""

import ctypes
import os
import signal
import sys

_M_ARENA_MAX = -8
"""glibc's number of the option, from malloc.h."""
_HEAPS = 2


def main() -> int:
    """Run ``geogs`` with the arguments of the process; returns its exit code.

    Until :func:`geogs.cli.main.main` handles Ctrl-C it ends the process as it ends any other,
    instead of in the middle of an import. Where it is ignored it stays so.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    _share_heaps()
    from geogs.cli.main import main as command

    return command()


def _share_heaps() -> None:
    """Let all threads share few heaps, unless MALLOC_ARENA_MAX says otherwise.

    By default glibc gives each thread its own, which keeps what it once freed: a fifth of the
    memory of a run on two cores.
    """
    if sys.platform == "linux" and "MALLOC_ARENA_MAX" not in os.environ:
        # musl's C library has neither heaps by thread nor the function.
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
        if mallopt is not None:
            mallopt(_M_ARENA_MAX, _HEAPS)
