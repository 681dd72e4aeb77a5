"""``checkpoint/`` in a folder of results: complete or absent; foreign files are never touched.

A manifest names every file of ours before it is made, and only those are ever deleted. A state's
files are new ones each time; it is complete once a manifest with their sizes and checksums has
replaced the last. Files are opened by plain names in the folder; links are not followed.

A seal proves that this user made a checkpoint with this cache folder: an HMAC-SHA256 by a key of 32
random bytes that is there alone. A checkpoint without a valid seal is used like any untrusted file.
"""

import errno
import hashlib
import hmac
import json
import os
import re
import secrets
import stat
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import BinaryIO, cast

from geogs.errors import InputError, OutputError
from geogs.gpu.cache import cache_folder
from geogs.guard.documents import UNUSABLE
from geogs.version import __version__
from geogs.world.arrays import NOT_STORED
from geogs.world.pack import pack, unpack

_KEY_BYTES = 32


def seal(data: bytes) -> str:
    """The seal of some bytes; empty where no key can be kept."""
    key = _key() or _new_key()
    return "" if key is None else hmac.digest(key, data, "sha256").hex()


def is_sealed(data: bytes, by: str) -> bool:
    """Whether this user made that seal of some bytes."""
    key = _key()
    if key is None:
        return False
    own = hmac.digest(key, data, "sha256").hex()
    return hmac.compare_digest(own.encode(), by.encode("utf-8", "replace"))


def _path() -> Path:
    return cache_folder() / "checkpoint.key"


def _key() -> bytes | None:
    """The key; none where there is none, or another user could have read or written it."""
    try:
        file = os.open(_path(), os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return None
    with os.fdopen(file, "rb") as stream:
        status = os.fstat(stream.fileno())
        is_plain = stat.S_ISREG(status.st_mode) and status.st_nlink == 1
        if not is_plain or status.st_uid != os.geteuid() or status.st_mode & 0o077:
            return None
        key = stream.read(_KEY_BYTES + 1)
    return key if len(key) == _KEY_BYTES else None


def _new_key() -> bytes | None:
    """Make and store a key, or take that of a faster process; none if it cannot be stored."""
    path = _path()
    unfinished = path.with_name(f"{path.name}.{secrets.token_hex(8)}")
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
        with os.fdopen(os.open(unfinished, flags, 0o600), "wb") as stream:
            stream.write(secrets.token_bytes(_KEY_BYTES))
        with suppress(FileExistsError):
            os.link(unfinished, path)  # atomic, and never over another key
    with suppress(OSError):
        unfinished.unlink()
    return _key()


FORMAT = "geogs checkpoint 3"
MANIFEST = "manifest.json"
_UNFINISHED = ".manifest.json.part"
_OUR_NAME = re.compile(r"state-\d{1,18}\.(json|safetensors)|archive-[0-9a-f]{16}")
_MODES = {os.O_RDONLY: "rb", os.O_WRONLY: "wb", os.O_RDWR: "r+b"}


@dataclass(frozen=True)
class Sum:
    """Expected size and checksum of a file."""

    size: int
    """Bytes."""
    sha256: str

    @staticmethod
    def of(data: bytes) -> "Sum":
        """The sum of a file with these bytes."""
        return Sum(len(data), hashlib.sha256(data).hexdigest())


@dataclass(frozen=True)
class Manifest:
    """List of the files that geogs wrote in a folder."""

    format: str
    geogs: str
    """The version that wrote it."""
    schema: str
    """Hash of the state's types, see :func:`geogs.world.kinds.schema`."""
    is_our_folder: bool
    """Whether geogs made the folder."""
    number: int
    """Number of the last state begun, from 1."""
    state: dict[str, Sum]
    """The files of the complete state, without archives, whose arrays have checksums of their own;
    empty if no state was completed."""
    files: list[str]
    """All files of ours that may exist, without the manifest."""
    is_own: bool = field(default=False, metadata=NOT_STORED)
    """Whether this user wrote it, see :func:`is_sealed`."""


class CheckpointFolder:
    """A folder that geogs makes, fills and removes; foreign files in it are left alone."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def manifest(self) -> Manifest | None:
        """Read the manifest; None if there is no folder, or no manifest in it.

        Raises:
            InputError: the folder or the manifest is a link, foreign, or damaged.
        """
        if not os.path.lexists(self.path):
            return None
        with self._opened() as folder:
            if MANIFEST not in os.listdir(folder):
                return None
        with self._open(MANIFEST, os.O_RDONLY) as file:
            # Largest manifest in bytes; it has about a hundred for every file.
            data = file.read(1 << 24)
        try:
            given = json.loads(data)
            checksum = given.pop("checksum")
            sealed = str(given.pop("seal", ""))
            manifest: Manifest = unpack(Manifest, given, {}, {})
        except (InputError, *UNUSABLE) as error:
            raise InputError(f"{MANIFEST} is damaged, or none of geogs") from error
        said = _json(pack(Manifest, manifest).values)
        if checksum != Sum.of(said).sha256:
            raise InputError(f"{MANIFEST} has changed")
        for name in (*manifest.state, *manifest.files):
            _check_name(name)
        return replace(manifest, is_own=is_sealed(said, sealed))

    def read(self, name: str, wanted: Sum) -> bytes:
        """Read a file. Raises InputError if its size or checksum is wrong."""
        with self._open(name, os.O_RDONLY) as file:
            size = os.fstat(file.fileno()).st_size
            if size < wanted.size:
                raise InputError(f"{name} is cut off")
            data = file.read(wanted.size)
        if size > wanted.size or Sum.of(data) != wanted:
            raise InputError(f"{name} has changed")
        return data

    @contextmanager
    def replaced(
        self, schema: str, archives: Collection[str]
    ) -> Iterator[Callable[[str, bytes], None]]:
        """Replace the state, completely or not at all, when the block ends without an error.

        Yields a function that writes a file of the new state, given the end of its name and its
        bytes; the ``archives`` that it refers to are made in the block, too. Files of only the
        last state are deleted.

        Raises:
            OutputError: the disk is full, or the folder cannot be written or is not ours.
        """
        try:
            last = self._last()
            number, sums = last.number + 1, dict[str, Sum]()
            new = [f"state-{number}.json", f"state-{number}.safetensors"]
            begun = replace(last, number=number, files=sorted({*last.files, *archives, *new}))
            self._write_manifest(begun)

            def write(ending: str, data: bytes) -> None:
                name = f"state-{number}.{ending}"
                assert name in new, f"{name} is not in the manifest"
                with self.create(name) as file:
                    file.write(data)
                    file.flush()
                    os.fsync(file.fileno())
                sums[name] = Sum.of(data)

            try:
                yield write
            except BaseException:
                self._delete(new)
                raise
            done = replace(begun, format=FORMAT, geogs=__version__, schema=schema, state=sums)
            self._write_manifest(done)
            self._delete(set(done.files).difference(archives, sums))
        except OSError as error:
            reason = error.strerror or error
            raise OutputError(
                f"{self.path} cannot be written ({reason}); free some space or give another output "
                "folder."
            ) from error
        except InputError as error:
            raise OutputError(f"{self.path} is left alone ({error}).") from error

    @contextmanager
    def create(self, name: str) -> Iterator[BinaryIO]:
        """Open a new file for reading and writing; it is deleted after an error.

        Raises OSError if there is one of that name.
        """
        try:
            with self._open(name, os.O_RDWR | os.O_CREAT | os.O_EXCL) as file:
                yield file
        except FileExistsError:
            raise
        except BaseException:
            self._delete([name])
            raise

    @contextmanager
    def change(self, name: str) -> Iterator[BinaryIO]:
        """Open a file for reading and writing. Raises InputError if it cannot be opened."""
        with self._open(name, os.O_RDWR) as file:
            yield file

    def remove(self) -> None:
        """Delete all files of ours, and the folder if we made it and nothing else is in it."""
        with suppress(OSError, InputError):
            manifest = self.manifest()
            if manifest is not None:
                self._delete([*manifest.files, _UNFINISHED])
                self._delete([MANIFEST])
            is_ours = self._is_just_begun() if manifest is None else manifest.is_our_folder
            if is_ours:
                self._delete([_UNFINISHED])
                self.path.rmdir()

    def _last(self) -> Manifest:
        """The present manifest, or a new one; the folder is made if it is missing."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        try:
            self.path.mkdir()
            is_our_folder = True
        except FileExistsError:
            is_our_folder = self._is_just_begun()
        last = self.manifest()
        if last is None:
            return Manifest(FORMAT, __version__, "", is_our_folder, 0, {}, [])
        with self._opened() as folder:
            there = set(os.listdir(folder))
        return replace(last, files=[name for name in last.files if name in there])

    def _is_just_begun(self) -> bool:
        """Whether the folder is empty, or holds only an unfinished first manifest."""
        with self._opened() as folder:
            return {*os.listdir(folder)} <= {_UNFINISHED}

    def _write_manifest(self, manifest: Manifest) -> None:
        values = pack(Manifest, manifest).values
        said = _json(values)
        signed = {"checksum": Sum.of(said).sha256, "seal": seal(said)}
        try:
            with self._open(_UNFINISHED, os.O_WRONLY | os.O_CREAT | os.O_TRUNC) as file:
                file.write(_json(values | signed))
                file.flush()
                os.fsync(file.fileno())
            with self._opened() as folder:
                os.replace(_UNFINISHED, MANIFEST, src_dir_fd=folder, dst_dir_fd=folder)
                os.fsync(folder)
        except OSError:
            self._delete([_UNFINISHED])
            with suppress(OSError):
                if manifest.is_our_folder:
                    self.path.rmdir()  # fails, unless that was the first manifest
            raise

    def _delete(self, names: Collection[str]) -> None:
        with self._opened() as folder:
            for name in names:
                _check_name(name)
                with suppress(OSError):
                    if stat.S_ISREG(os.lstat(name, dir_fd=folder).st_mode):
                        os.unlink(name, dir_fd=folder)

    @contextmanager
    def _opened(self) -> Iterator[int]:
        """The folder's descriptor. Raises InputError if it is a link, or no folder."""
        if self.path.is_symlink():
            raise InputError("it is a link, and none is followed")
        try:
            folder = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        except NotADirectoryError as error:
            raise InputError("it is no folder") from error
        try:
            yield folder
        finally:
            os.close(folder)

    @contextmanager
    def _open(self, name: str, flags: int) -> Iterator[BinaryIO]:
        """A file of the folder. Raises InputError if it is a link, or cannot be opened."""
        _check_name(name)
        with self._opened() as folder:
            try:  # non-blocking, not to wait for a pipe
                number = os.open(name, flags | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666, dir_fd=folder)
            except OSError as error:
                if flags & os.O_CREAT and error.errno != errno.ELOOP:
                    raise
                is_link = error.errno == errno.ELOOP
                reason = "is a link, and none is followed" if is_link else "cannot be opened"
                raise InputError(f"{name} {reason}") from error
        status = os.fstat(number)
        if not stat.S_ISREG(status.st_mode) or status.st_nlink != 1:
            os.close(number)
            raise InputError(f"{name} is no plain file, or has other names")
        with os.fdopen(number, _MODES[flags & os.O_ACCMODE]) as file:
            yield cast(BinaryIO, file)


def _check_name(name: str) -> None:
    """Raise InputError if a name is not one of geogs: no other file is ever touched."""
    if name not in (MANIFEST, _UNFINISHED) and not _OUR_NAME.fullmatch(name):
        raise InputError(f"{name!r} is no name of a file of a checkpoint")


def _json(values: object) -> bytes:
    return json.dumps(values).encode()
