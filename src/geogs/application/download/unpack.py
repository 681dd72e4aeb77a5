"""Safe unpacking of image archives: only plain files and folders inside one folder."""

import shutil
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from pathlib import Path, PurePosixPath
from typing import IO

from geogs.errors import InputError, OutputError

_MAX_RATIO = 50
"""Largest ratio of unpacked to archive size: images hardly shrink."""
_MIN_LIMIT = 1 << 30
"""Unpacked size in bytes that is always allowed."""

Member = tuple[str, int, Callable[[], IO[bytes] | None]]
"""Name, size in bytes, and opener of a plain file in an archive."""


def unpack(archive: Path, folder: Path) -> None:
    """Unpack a ``.zip`` or a tar file into a new folder, without a common top folder.

    Raises:
        InputError: it is damaged, or holds links, devices, or names that lead out of the folder.
        OutputError: a file cannot be written.
    """
    most = max(_MAX_RATIO * archive.stat().st_size, _MIN_LIMIT)
    try:
        folder.mkdir(parents=True)
        for name, size, opened in _members(archive):
            most -= size
            if most < 0:
                raise InputError(f"{archive} would unpack to far more than images; it is not used.")
            _write(folder / _inside(name, archive), opened)
    except (tarfile.TarError, zipfile.BadZipFile, zlib.error, EOFError, RuntimeError) as error:
        raise InputError(f"{archive} is damaged ({error}); delete it and fetch it again.") from None
    except OSError as error:
        if error.strerror is None:  # gzip's error for a damaged file
            raise InputError(f"{archive} is damaged; delete it and fetch it again.") from None
        raise OutputError(f"{folder} cannot be written ({error.strerror}).") from None
    _lift(folder)


def _members(archive: Path) -> Iterator[Member]:
    """The plain files. Raises InputError for anything but files and folders."""
    if zipfile.is_zipfile(archive):
        with zipfile.ZipFile(archive) as packed:
            for entry in packed.infolist():
                kind = entry.external_attr >> 28
                if kind not in (0, 0o4, 0o10):
                    raise InputError(f"{archive} holds what is no plain file; it is not used.")
                if not entry.is_dir():
                    yield entry.filename, entry.file_size, partial(packed.open, entry)
        return
    with tarfile.open(archive, "r:*") as tar:
        for member in tar:
            if not (member.isreg() or member.isdir()):
                raise InputError(f"{archive} holds what is no plain file; it is not used.")
            if member.isreg():
                yield member.name, member.size, partial(tar.extractfile, member)


def _inside(name: str, archive: Path) -> PurePosixPath:
    """The name below the folder. Raises InputError for one that leads elsewhere."""
    path = PurePosixPath(name)
    leads_out = path.is_absolute() or ".." in path.parts or "\\" in name or "\0" in name
    if leads_out or ":" in name or not path.parts:
        raise InputError(f"{archive} holds a name that leads out of its folder; it is not used.")
    return path


def _write(path: Path, opened: Callable[[], IO[bytes] | None]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    stream = opened()
    assert stream is not None, "of a plain file"
    with closing(stream), path.open("xb") as file:
        shutil.copyfileobj(stream, file, 1 << 20)


def _lift(folder: Path) -> None:
    """Replace the folder by its only sub-folder, if all lies in that."""
    inside = list(folder.iterdir())
    if len(inside) == 1 and inside[0].is_dir():
        own = inside[0].rename(folder.with_name(f"{folder.name}.inner"))
        folder.rmdir()
        own.rename(folder)
