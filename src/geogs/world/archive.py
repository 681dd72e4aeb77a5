"""Arrays that leave the memory for a file until they are wanted again.

A long video has more keyframes than fit into memory, and seldom are old ones looked at. The file
is read and written at offsets and never mapped, so nothing of it counts as memory of the process.
"""

import math
import os
import tempfile
import threading
import uuid
import weakref
import zlib
from collections import deque
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Protocol

import numpy as np

from geogs.errors import InputError, OutputError

_PIECE = 1 << 24
"""Bytes copied at once."""


class Archive:
    """A file of arrays of any shape and type, for as long as the process lasts.

    It lies in ``folder``, or where the system keeps temporary files (``TMPDIR``), has no name there
    and so vanishes with the process, however that ends. Space of arrays that nobody refers to any
    more is used again.

    For a checkpoint the file gets a name (``settle``), and what the last checkpoint refers to stays
    until the next one is complete (``release``). Every array has a checksum from when it was
    written, which is compared when a checkpoint is read: so a checkpoint costs what is new in it,
    and damage is found before any work is done with it.
    """

    def __init__(self, folder: Path | str | None = None) -> None:
        self.folder = Path(folder or tempfile.gettempdir())
        self.name = f"archive-{uuid.uuid4().hex[:16]}"
        """Name of the file, once it is settled."""
        self._free: dict[int, list[int]] = {}
        """Offsets of unused pieces, by their size."""
        self._gone: deque[tuple[int, int]] = deque()
        """Offset and size of what nobody refers to any more; collected without a lock."""
        self._end = 0
        self._lock = threading.Lock()
        self._is_settled = False
        self._withheld: list[tuple[int, int]] = []
        """Offset and size of what is gone, but not for the last checkpoint."""
        self._releasing: list[tuple[int, int]] = []
        """The same of what is gone for the checkpoint that is being written, too."""
        try:
            self._file = tempfile.TemporaryFile(dir=self.folder, buffering=0)  # noqa: SIM115
        except OSError as error:
            raise self._unwritable(error) from error
        weakref.finalize(self, self._file.close)

    def put(self, array: np.ndarray) -> "Archived":
        """Write an array.

        Raises OutputError if the disk is full, or cannot be written.
        """
        with self._lock:
            self._collect()
            pieces = self._free.get(array.nbytes)
            offset = pieces.pop() if pieces else self._end
            self._end = max(self._end, offset + array.nbytes)
        data = np.ascontiguousarray(array)
        archived = self._archived(offset, array.shape, array.dtype, zlib.crc32(_bytes(data)))
        self._write(data, offset)
        return archived

    def read(self, archived: "Archived") -> np.ndarray:
        """An array as it was written.

        Raises OutputError if the file has been cut off.
        """
        array = np.empty(archived.shape, archived.dtype)
        rest, offset = _bytes(array), archived.offset
        while rest:
            done = os.preadv(self._file.fileno(), [rest], offset)
            if done == 0:
                raise OutputError(f"The archive in {self.folder} has been cut off.")
            rest, offset = rest[done:], offset + done
        return array

    # --- checkpoints -----------------------------------------------------------------------

    def settle(self, folder: "NamedFiles") -> "SettledArchive":
        """Put all that was written on the disk under its name in a folder; what to open it by.

        Raises OutputError if the disk is full, or cannot be written.
        """
        try:
            if not self._is_settled or self.folder != folder.path:
                self._move(folder)
            os.fsync(self._file.fileno())
        except OSError as error:
            raise self._unwritable(error, folder.path) from error
        with self._lock:
            self._collect()
        self._releasing, self._withheld = self._releasing + self._withheld, []
        unused = [(o, size) for size, offsets in self._free.items() for o in offsets]
        return SettledArchive(self._end, [*unused, *self._releasing])

    def release(self) -> None:
        """The checkpoint that was written since ``settle`` is complete and replaces the last."""
        for offset, size in self._releasing:
            self._free.setdefault(size, []).append(offset)
        self._releasing = []

    @classmethod
    def reopened(cls, folder: "NamedFiles", name: str, settled: "SettledArchive") -> "Archive":
        """The archive as it was when it was settled; what was written later is cut off.

        Raises InputError if the file is missing, too short, or what is said of it cannot be.
        """
        parts = [(0, settled.end), *settled.free]
        if any(min(p) < 0 or sum(p) > settled.end for p in parts):
            raise InputError(f"what is said of {name} cannot be")
        archive = cls(folder.path)
        with folder.change(name) as file:
            if os.fstat(file.fileno()).st_size < settled.end:
                raise InputError(f"{name} is cut off")
            os.truncate(file.fileno(), settled.end)
            os.dup2(file.fileno(), archive._file.fileno())
        archive.name, archive._is_settled, archive._end = name, True, settled.end
        for offset, size in settled.free:
            archive._free.setdefault(size, []).append(offset)
        return archive

    def piece(
        self, offset: int, shape: tuple[int, ...], dtype: np.dtype, checksum: int
    ) -> "Archived":
        """An array that a checkpoint says is in the file; it is read to be sure.

        Raises InputError if it is not there, or has changed.
        """
        if min(offset, *shape, 0) < 0 or offset + math.prod(shape) * dtype.itemsize > self._end:
            raise InputError(f"{self.name} does not reach as far as it should")
        archived = self._archived(offset, shape, dtype, checksum)
        if zlib.crc32(_bytes(self.read(archived))) != checksum:
            raise InputError(f"{self.name} has changed")
        return archived

    def _move(self, folder: "NamedFiles") -> None:
        """Copy the file to another place, where it is from then on."""
        with folder.create(self.name) as named:
            done = 0
            while done < self._end:
                piece = os.pread(self._file.fileno(), min(_PIECE, self._end - done), done)
                if not piece:  # something could not be written
                    break
                done += os.pwrite(named.fileno(), piece, done)
            os.truncate(named.fileno(), self._end)
            os.dup2(named.fileno(), self._file.fileno())  # other threads notice nothing
        self.folder, self._is_settled = folder.path, True

    def _archived(
        self, offset: int, shape: tuple[int, ...], dtype: np.dtype, checksum: int
    ) -> "Archived":
        """A reference to an array; its space is used again once nobody has one any more."""
        archived = Archived(self, offset, shape, dtype, checksum)
        size = math.prod(shape) * dtype.itemsize
        weakref.finalize(archived, self._gone.append, (offset, size))
        return archived

    # --- the file --------------------------------------------------------------------------

    def _write(self, array: np.ndarray, offset: int) -> None:
        rest = _bytes(array)
        try:
            while rest:
                done = os.pwrite(self._file.fileno(), rest, offset)
                rest, offset = rest[done:], offset + done
        except OSError as error:
            raise self._unwritable(error) from error

    def _collect(self) -> None:
        """Make the space of arrays that are gone free for others."""
        while self._gone:
            offset, size = self._gone.popleft()
            if self._is_settled:
                self._withheld.append((offset, size))
            else:
                self._free.setdefault(size, []).append(offset)

    def _unwritable(self, error: OSError, settled: Path | None = None) -> OutputError:
        """The error of this file, or of the one that it becomes in a folder where it is settled."""
        settled = settled or (self.folder if self._is_settled else None)
        remedy = (
            "name a folder on a larger disk in TMPDIR" if settled is None
            else "give a folder on a larger disk for the results"
        )  # fmt: skip
        return OutputError(
            f"The keyframes of a long video cannot be kept in {settled or self.folder} "
            f"({error.strerror or error}); free some space, or {remedy}."
        )


@dataclass(frozen=True)
class SettledArchive:
    """What a checkpoint says of an archive."""

    end: int
    """Bytes of the file."""
    free: list[tuple[int, int]]
    """Offset and size of its unused pieces."""


class NamedFiles(Protocol):
    """A folder of files by name."""

    @property
    def path(self) -> Path:
        """Where it is."""
        ...

    def create(self, name: str) -> AbstractContextManager[BinaryIO]:
        """A new file for reading and writing, which is gone again after an error.

        Raises OSError if there is one of that name.
        """
        ...

    def change(self, name: str) -> AbstractContextManager[BinaryIO]:
        """A file for reading and writing. Raises InputError if there is none."""
        ...


class Archived:
    """An array in an archive."""

    __slots__ = ("__weakref__", "archive", "checksum", "dtype", "offset", "shape")

    def __init__(
        self, archive: Archive, offset: int, shape: tuple[int, ...], dtype: np.dtype, checksum: int
    ) -> None:
        self.archive = archive
        self.offset = offset
        self.shape = shape
        self.dtype = dtype
        self.checksum = checksum
        """CRC-32 of its bytes."""

    def load(self) -> np.ndarray:
        """The array as it was archived."""
        return self.archive.read(self)


def _bytes(array: np.ndarray) -> memoryview:
    """The bytes of an array that lies row by row."""
    return memoryview(array.reshape(-1).view(np.uint8).data)
