"""Atomic files: written under a temporary name in the same folder, then renamed."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from secrets import token_hex
from tempfile import TemporaryFile
from typing import BinaryIO

from geogs.errors import OutputError
from geogs.guard.documents import expanded

_FULL = (errno.ENOSPC, errno.EDQUOT)


@contextmanager
def atomic_file(path: str | Path) -> Iterator[BinaryIO]:
    """Open ``path`` for binary writing; it is replaced when the block ends without an error.

    Missing folders are made. After an error the previous file is still there and the unfinished
    one is gone.

    Raises:
        OutputError: the disk is full, or the folder cannot be written.
    """
    path = Path(path)
    # Others may write the same file at the same time, also from another machine.
    unfinished = path.with_name(f".{path.name}.{token_hex(6)}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with unfinished.open("wb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(unfinished, path)
    except OSError as error:
        raise unwritable(path, error) from error
    finally:
        with suppress(OSError):
            unfinished.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Write a text file in UTF-8, completely or not at all."""
    with atomic_file(path) as stream:
        stream.write(text.encode("utf-8", "backslashreplace"))  # names may be no UTF-8


def prepare_output_folder(path: str | Path) -> Path:
    """Make the folder for results and test that files can be written there.

    Called at the beginning of a run, so that hours of work do not end at a read-only disk.

    Raises:
        OutputError: it is a file, or cannot be made or written.
    """
    folder = expanded(path)
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder} is a file; give another folder for the results.")
    if folder.is_symlink() and not folder.exists():
        raise OutputError(
            f"{folder} is a link to {os.readlink(folder)}, which does not exist; make that folder, "
            "or give another one for the results."
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=folder):
            return folder
    except OSError as error:
        raise unwritable(folder, error) from error


def unwritable(path: Path, error: OSError) -> OutputError:
    """The error to raise where a file or folder cannot be written."""
    remedy = "give another output folder"
    if error.errno in _FULL:
        remedy = f"free some space on {_disk_of(path)}"
    elif error.errno in (errno.EMFILE, errno.ENFILE):
        remedy = "raise the limit of open files (ulimit -n)"
    return OutputError(f"{path} cannot be written ({error.strerror or error}); {remedy}.")


def _disk_of(path: Path) -> str:
    """Mount point of the disk of a file, which may not exist, in words."""
    try:
        place = next(p for p in (path.absolute(), *path.absolute().parents) if p.exists())
        while not place.is_mount() and place != place.parent:
            place = place.parent
        return f"the disk at {place}"
    except OSError:
        return "its disk"
