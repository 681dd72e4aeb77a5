"""Arrays that are moved from memory to a file and read back when needed.

The keyframes of a long video do not fit into memory, and old ones are rarely used. The file is
read and written at offsets and never mapped, so it does not count as memory of the process.
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


class Archive:
    """A file of arrays of any shape and type, for as long as the process lasts.

    It lies in ``folder``, or in the system's temporary folder (``TMPDIR``). It has no name there
    and so vanishes with the process, however that ends. Space of unreferenced arrays is reused.

    For a checkpoint the file gets a name (``settle``), and arrays of the last checkpoint stay until
    the next one is complete (``release``). Every array gets a checksum when it is written, which is
    compared when a checkpoint is read. So a checkpoint only costs its new arrays, and damage is
    found before any work is done with it.
    """

    def __init__(self, folder: Path | str | None = None) -> None:
        self.folder = Path(folder or tempfile.gettempdir())
        self.name = f"archive-{uuid.uuid4().hex[:16]}"
        """Name of the file, once it is settled."""
        self._free: dict[int, list[int]] = {}
        """Offsets of unused pieces, by their size."""
        self._gone: deque[tuple[int, int]] = deque()
        """Offset and size of unreferenced arrays; collected without a lock."""
        self._end = 0
        self._lock = threading.Lock()
        self._is_settled = False
        self._withheld: list[tuple[int, int]] = []
        """Offset and size of unreferenced arrays that the last checkpoint still needs."""
        self._releasing: list[tuple[int, int]] = []
        """The same, but not needed by the checkpoint being written, either."""
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
        """Read an array back.

        Raises OutputError if the file has been cut off.
        """
        array = np.empty(archived.shape, archived.dtype)
        rest = _bytes(array)
        offset = archived.offset
        while rest:
            done = os.preadv(self._file.fileno(), [rest], offset)
            if done == 0:
                raise OutputError(f"The archive in {self.folder} has been cut off.")
            rest = rest[done:]
            offset = offset + done
        return array

    # --- checkpoints -----------------------------------------------------------------------

    def settle(self, folder: "NamedFiles") -> "SettledArchive":
        """Flush the file to disk under its name in a folder; return what is needed to reopen it.

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
        self._releasing = self._releasing + self._withheld
        self._withheld = []
        unused = [(o, size) for size, offsets in self._free.items() for o in offsets]
        return SettledArchive(self._end, [*unused, *self._releasing])

    def release(self) -> None:
        """Note that the checkpoint written since ``settle`` is complete and replaces the last."""
        for offset, size in self._releasing:
            self._free.setdefault(size, []).append(offset)
        self._releasing = []

    @classmethod
    def reopened(cls, folder: "NamedFiles", name: str, settled: "SettledArchive") -> "Archive":
        """Reopen the archive as it was when settled; later data is cut off.

        Raises InputError if the file is missing or too short, or its description is invalid.
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
        archive.name = name
        archive._is_settled = True
        archive._end = settled.end
        for offset, size in settled.free:
            archive._free.setdefault(size, []).append(offset)
        return archive

    def piece(
        self, offset: int, shape: tuple[int, ...], dtype: np.dtype, checksum: int
    ) -> "Archived":
        """Return an array that a checkpoint refers to, after reading it to check it.

        Raises InputError if it is not there, or has changed.
        """
        if min(offset, *shape, 0) < 0 or offset + math.prod(shape) * dtype.itemsize > self._end:
            raise InputError(f"{self.name} does not reach as far as it should")
        archived = self._archived(offset, shape, dtype, checksum)
        if zlib.crc32(_bytes(self.read(archived))) != checksum:
            raise InputError(f"{self.name} has changed")
        return archived

    def _move(self, folder: "NamedFiles") -> None:
        """Move the file into another folder."""
        with folder.create(self.name) as named:
            done = 0
            while done < self._end:
                piece = os.pread(self._file.fileno(), min(1 << 24, self._end - done), done)
                if not piece:  # something could not be written
                    break
                done += os.pwrite(named.fileno(), piece, done)
            os.truncate(named.fileno(), self._end)
            os.dup2(named.fileno(), self._file.fileno())  # other threads notice nothing
        self.folder = folder.path
        self._is_settled = True

    def _archived(
        self, offset: int, shape: tuple[int, ...], dtype: np.dtype, checksum: int
    ) -> "Archived":
        """Return a reference to an array; its space is reused once no reference is left."""
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
                rest = rest[done:]
                offset = offset + done
        except OSError as error:
            raise self._unwritable(error) from error

    def _collect(self) -> None:
        """Free the space of unreferenced arrays."""
        while self._gone:
            offset, size = self._gone.popleft()
            if self._is_settled:
                self._withheld.append((offset, size))
            else:
                self._free.setdefault(size, []).append(offset)

    def _unwritable(self, error: OSError, settled: Path | None = None) -> OutputError:
        """Return the error for this file, or for the settled file in a folder."""
        settled = settled or (self.folder if self._is_settled else None)
        remedy = (
            "name a folder on a larger disk in TMPDIR"
            if settled is None
            else "give a folder on a larger disk for the results"
        )
        return OutputError(
            f"The keyframes of a long video cannot be kept in {settled or self.folder} "
            f"({error.strerror or error}); free some space, or {remedy}."
        )


@dataclass(frozen=True)
class SettledArchive:
    """Description of an archive in a checkpoint."""

    end: int
    """Bytes of the file."""
    free: list[tuple[int, int]]
    """Offset and size of its unused pieces."""


class NamedFiles(Protocol):
    """A folder of files by name."""

    @property
    def path(self) -> Path:
        """Path of the folder."""
        ...

    def create(self, name: str) -> AbstractContextManager[BinaryIO]:
        """Create a file for reading and writing; it is removed again after an error.

        Raises OSError if there is one of that name.
        """
        ...

    def change(self, name: str) -> AbstractContextManager[BinaryIO]:
        """Open a file for reading and writing. Raises InputError if there is none."""
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
        """Read the array."""
        return self.archive.read(self)


def _bytes(array: np.ndarray) -> memoryview:
    """Bytes of a C-contiguous array."""
    return memoryview(array.reshape(-1).view(np.uint8).data)
