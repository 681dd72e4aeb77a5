"""One run at a time writes into a folder of results; a lock ends with the process that has it."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from geogs.errors import OutputError

LOCK = ".geogs.lock"
"""Name of the file that is locked."""


@contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Inside, nobody else who asks likewise writes into a folder, where that can have locks.

    Raises:
        OutputError: another process writes there.
    """
    path = folder / LOCK
    try:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o666)
    except OSError:
        yield
        return
    try:
        if not _is_locked(file, path):
            raise OutputError(
                f"Another run is writing into {folder}; wait for it, or give another folder (-o)."
            )
        try:
            yield
        finally:
            with suppress(OSError):
                path.unlink()
    finally:
        os.close(file)


def _is_locked(file: int, path: Path) -> bool:
    """Whether the file is ours now, and still the one of that name."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return True
    try:
        return os.path.samestat(os.fstat(file), os.stat(path))
    except FileNotFoundError:
        return False
