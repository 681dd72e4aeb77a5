"""The folder of a result: choice of a free one, and locks for writing."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import Any

from geogs.documents import expanded, read_json
from geogs.errors import InputError, OutputError
from geogs.io.writers.atomic import prepare_output_folder
from geogs.io.writers.replacement import recover

LOCK = ".geogs.lock"
"""Name of the lock file."""


@contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Lock a folder for one writer in the block, if its file system has locks.

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
    """Lock a file. Returns whether it is ours now, and still the one of that name."""
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


@contextmanager
def claimed(folder: Path) -> Iterator[Path]:
    """Make and lock the folder of a result for the block.

    An interrupted write there is completed or undone. New folders are deleted again if they stay
    empty.

    Raises:
        OutputError: it cannot be made or written, or another process writes there.
    """
    folder = expanded(folder)
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        output = prepare_output_folder(folder)
        with only_writer(output):
            recover(output)
            yield output
    finally:
        with suppress(OSError):
            for path in made:
                path.rmdir()


def free_folder(wanted: Path, fingerprint: str) -> Path:
    """The folder, or the next with a number after its name, without a result of another source.

    ``fingerprint`` distinguishes sources of one name.
    """
    for number in count(1):
        folder = wanted if number == 1 else wanted.with_name(f"{wanted.name}-{number}")
        if not _is_of_another(folder, fingerprint):
            return folder
    raise AssertionError("count never ends")


def read_summary(folder: Path) -> dict[str, Any]:
    """Read ``summary.json`` in a folder. Raises InputError if it is missing or damaged."""
    path = folder / "summary.json"
    summary = read_json(path)
    if not isinstance(summary, dict):
        raise InputError(f"{path} is damaged; it holds no summary of a run.")
    return summary


def _is_of_another(folder: Path, fingerprint: str) -> bool:
    if not folder.is_dir():
        return False
    from geogs.application.checkpoints.checkpoint import has_checkpoint

    try:
        summary = read_json(folder / "summary.json")
    except InputError:
        return has_checkpoint(folder) and _begun_with(folder) not in (None, fingerprint)
    return not isinstance(summary, dict) or summary.get("fingerprint") != fingerprint


def _begun_with(folder: Path) -> str | None:
    """Fingerprint of an unfinished run's source; none where that is not known."""
    from geogs.application.checkpoints.run_state import SavedRun

    try:
        return SavedRun(folder).metadata.fingerprint
    except InputError:
        return None
