"""A folder held open: operations by name stay inside it, as no link in it is followed."""

import errno
import hashlib
import os
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import BufferedReader
from pathlib import Path

_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW
_FILE = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK


class Directory:
    """A folder, by its handle.

    Names have ``/`` between folders. Each part but the last must be a folder in the one before, and
    the last is not followed: a link is moved or deleted itself.

    Every method raises OSError, also for a name that leads elsewhere.
    """

    def __init__(self, path: Path, handle: int) -> None:
        self.path = path
        self._handle = handle

    @staticmethod
    @contextmanager
    def opened(path: Path) -> Iterator["Directory"]:
        """Open the folder of a path: links may lead to it, but not on from it."""
        handle = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
        try:
            yield Directory(path, handle)
        finally:
            os.close(handle)

    @property
    def reach(self) -> Path:
        """A path by the handle, which leads there also when another folder has got the name; the
        path itself where the system has none."""
        by_handle = Path(f"/proc/self/fd/{self._handle}")
        return by_handle if by_handle.exists() else self.path

    def is_at_its_path(self) -> bool:
        """Whether its path still leads to it."""
        return identity(self._handle) == identity(self.path)

    @contextmanager
    def inner(self, name: str) -> Iterator["Directory"]:
        """A folder in this one."""
        with self._parent(name) as (parent, last), parent._folder(last) as folder:
            yield folder

    def names(self) -> list[str]:
        """Names of its entries, in order."""
        return sorted(os.listdir(self._handle))

    def folders(self) -> Iterator[str]:
        """Names of all folders below, each before those in it."""
        for name in self.names():
            if self.is_folder(name):
                yield name
                with self.inner(name) as inner:
                    yield from (f"{name}/{below}" for below in inner.folders())

    def files(self) -> Iterator[str]:
        """Names of all files below."""
        for folder in (".", *self.folders()):
            with self.inner(folder) as inner:
                yield from (
                    name if folder == "." else f"{folder}/{name}"
                    for name in inner.names()
                    if not inner.is_folder(name)
                )

    def is_folder(self, name: str) -> bool:
        """Whether there is a folder of that name; a link is none."""
        with self._parent(name) as (parent, last), suppress(FileNotFoundError):
            return stat.S_ISDIR(parent._status(last).st_mode)
        return False

    def number(self, name: str) -> int:
        """The inode number of an entry."""
        with self._parent(name) as (parent, last):
            return parent._status(last).st_ino

    def read(self, name: str, largest: int) -> bytes:
        """The beginning of a plain file, up to ``largest`` bytes."""
        with self._file(name) as file:
            return file.read(largest)

    def sha256(self, name: str) -> str:
        """Digest of a plain file."""
        with self._file(name) as file:
            return hashlib.file_digest(file, "sha256").hexdigest()

    def make(self, name: str) -> bool:
        """Make a folder. Returns whether there was none."""
        with self._parent(name) as (parent, last):
            if parent.is_folder(last):
                return False
            try:
                os.mkdir(last, dir_fd=parent._handle)
            except FileExistsError:
                with parent._folder(last):
                    return False
            return True

    def move(self, name: str, target: "Directory", new_name: str) -> None:
        """Move an entry to a name in another folder; an entry of that name is replaced."""
        with self._parent(name) as (here, old), target._parent(new_name) as (there, new):
            os.replace(old, new, src_dir_fd=here._handle, dst_dir_fd=there._handle)

    def delete(self, name: str) -> None:
        """Delete a file, and the folders above that are empty now."""
        with self._parent(name) as (parent, last):
            os.unlink(last, dir_fd=parent._handle)
        with suppress(OSError):
            while "/" in name:
                name = name.rpartition("/")[0]
                self.delete_empty(name)

    def delete_empty(self, name: str) -> None:
        """Delete an empty folder."""
        with self._parent(name) as (parent, last):
            os.rmdir(last, dir_fd=parent._handle)

    def delete_all(self, name: str) -> None:
        """Delete a folder with its content, as far as possible."""
        with self._parent(name) as (parent, last):
            shutil.rmtree(last, ignore_errors=True, dir_fd=parent._handle)

    def sync(self) -> None:
        """Wait until its names are on the disk."""
        with suppress(OSError):  # not every file system does that
            os.fsync(self._handle)

    def _status(self, name: str) -> os.stat_result:
        return os.stat(name, dir_fd=self._handle, follow_symlinks=False)

    @contextmanager
    def _parent(self, name: str) -> Iterator[tuple["Directory", str]]:
        """The folder of the last part of a name, and that part."""
        first, _, rest = name.partition("/")
        if not first or first == ".." or "\0" in name or (first == "." and rest):
            raise FileNotFoundError(f"{name!r} is no name of what is in a folder")
        if not rest:
            yield self, first
            return
        with self._folder(first) as folder, folder._parent(rest) as found:
            yield found

    @contextmanager
    def _folder(self, name: str) -> Iterator["Directory"]:
        path = self.path / name
        if not stat.S_ISDIR(self._status(name).st_mode):
            reason = f"{path} is a link or no folder, and no link is followed"
            raise NotADirectoryError(errno.ENOTDIR, reason)
        handle = os.open(name, _FOLDER, dir_fd=self._handle)
        try:
            yield Directory(path, handle)
        finally:
            os.close(handle)

    @contextmanager
    def _file(self, name: str) -> Iterator[BufferedReader]:
        with self._parent(name) as (parent, last):
            number = os.open(last, _FILE, dir_fd=parent._handle)
        with os.fdopen(number, "rb") as file:
            if not stat.S_ISREG(os.fstat(number).st_mode):
                raise FileNotFoundError(f"{name} is no plain file")
            yield file


def identity(place: Path | int) -> tuple[int, int] | None:
    """Numbers of the disk and of the folder that a path or a handle leads to; None for nothing."""
    with suppress(OSError):
        status = os.stat(place)
        return status.st_dev, status.st_ino
    return None
