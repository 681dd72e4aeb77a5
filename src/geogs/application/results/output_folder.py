"""The folder of a result: choice of a free one, and locks for writing."""

import fcntl
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import chain, count
from pathlib import Path
from typing import Any

from geogs.application.progress.run_progress import RunProgress
from geogs.errors import InputError, OutputError
from geogs.guard.atomic import prepare_output_folder
from geogs.guard.documents import expanded, in_short, read_json
from geogs.guard.replacement import is_half_done, recover

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


def chosen_folder(
    given: Path | None,
    name: str,
    overwrite: bool,
    progress: RunProgress | None = None,
    fingerprint: Callable[[], str] | None = None,
) -> Path:
    """The folder for a new result: the given one, else out/NAME, or out/NAME-2 where that is taken.

    Args:
        given: folder that the user named; none if they named none.
        name: name of the source.
        overwrite: whether an earlier result, or an unfinished run, may be replaced.
        progress: is told which folder is taken instead of ``out/NAME``, or what is replaced.
        fingerprint: makes that of the source, whose earlier result in a given folder may be
            replaced; asked only where there is one, as it looks at all files of the source.

    Raises:
        OutputError: the given folder holds the result of another source, or an unfinished run.
    """
    wanted = given or Path("out") / name
    held = content(wanted)
    if overwrite or not held:
        return wanted
    if given is not None and fingerprint and _summary_value(wanted, "fingerprint") == fingerprint():
        if progress is not None:
            progress.write(f"{wanted} holds {held}; a complete new one replaces it.")
        return wanted
    if given is not None:
        ways = "give another folder (-o), or --overwrite to replace it."
        raise OutputError(f"{wanted} holds {held}; {ways}")
    free = free_folder(wanted)
    if progress is not None:
        progress.write(f"{wanted} holds {held}, which stays; this result goes to {free}.")
    return free


def free_folder(wanted: Path) -> Path:
    """The folder, or the next with a number after its name, that holds no result."""
    numbered = (wanted.with_name(f"{wanted.name}-{number}") for number in count(2))
    return next(folder for folder in chain([wanted], numbered) if not content(folder))


def content(folder: Path) -> str:
    """Describe the result or unfinished run in a folder; empty if there is none."""
    folder = expanded(folder)
    if os.path.lexists(folder / "summary.json") or is_half_done(folder):
        source = _source_of(folder)
        return f"the result of {source}" if source else "a result"
    from geogs.application.checkpoints.checkpoint import has_checkpoint

    if folder.is_dir() and has_checkpoint(folder):
        return f"an unfinished run (geogs run --resume {folder} continues it)"
    return ""


def is_complete(folder: Path) -> bool:
    """Whether a folder holds a result that was made to its end, and has a mesh."""
    is_whole = _summary_value(folder, "interrupted") is False
    return is_whole and (expanded(folder) / "mesh.ply").is_file()


def read_summary(folder: Path) -> dict[str, Any]:
    """Read ``summary.json`` in a folder. Raises InputError if it is missing or damaged."""
    path = folder / "summary.json"
    summary = read_json(path)
    if not isinstance(summary, dict):
        raise InputError(f"{path} is damaged; it holds no summary of a run.")
    return summary


def _summary_value(folder: Path, key: str) -> object:
    """A value of a result's summary; none if there is no summary, or it has no such value."""
    try:
        return read_summary(folder).get(key)
    except InputError:
        return None


def _source_of(folder: Path) -> str:
    """Name of the source of a result, as its summary has it; empty where it has none."""
    source = _summary_value(folder, "source")
    return in_short(str(source)).strip() if source else ""
