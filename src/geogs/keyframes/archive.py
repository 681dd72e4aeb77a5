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
from collections import deque
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geogs.errors import InputError, OutputError
from geogs.keyframes.swap import Swap

_PIECE = 1 << 24
"""Bytes copied at once."""


class Archive:
    """A file of arrays of any shape and type, for as long as the process lasts.

    It lies in ``folder``, or where the system keeps temporary files (``TMPDIR``), has no name there
    and so vanishes with the process, however that ends. The last ``resident`` arrays written or
    read stay in memory as well. Space of arrays that nobody refers to any more is used again.

    For a checkpoint the file gets a name (``settle``), and what the last checkpoint refers to stays
    until the next one is complete (``release``).
    """

    def __init__(self, folder: Path | str | None = None, resident: int = 0) -> None:
        self.folder = Path(folder or tempfile.gettempdir())
        self._recent: Swap[int, np.ndarray] = Swap(resident)
        self._free: dict[int, list[int]] = {}
        """Offsets of unused pieces, by their size."""
        self._gone: deque[tuple[int, int, int]] = deque()
        """Key, offset and size of what nobody refers to any more; collected without a lock."""
        self._end = self._next_key = 0
        self._lock = threading.Lock()
        self._path: Path | None = None
        """Of the named file."""
        self._withheld: list[tuple[int, int]] = []
        """Offset and size of what is gone, but not for the last checkpoint."""
        self._releasing: list[tuple[int, int]] = []
        """The same of what is gone for the checkpoint that is being written, too."""
        try:
            self._file = tempfile.TemporaryFile(dir=self.folder, buffering=0)  # noqa: SIM115
        except OSError as error:
            raise self._unwritable(error) from error

    @property
    def size(self) -> int:
        """Bytes of the file."""
        return self._end

    @property
    def settled_name(self) -> str | None:
        """Name of the file, if it has one."""
        return None if self._path is None else self._path.name

    def put(self, array: np.ndarray) -> "Archived":
        """Write an array; it must not be changed while it is resident.

        Raises:
            OutputError: the disk is full, or cannot be written.
        """
        with self._lock:
            self._collect()
            pieces = self._free.get(array.nbytes)
            offset = pieces.pop() if pieces else self._end
            self._end = max(self._end, offset + array.nbytes)
            self._next_key += 1
        archived = self.archived(self._next_key, offset, array.shape, array.dtype)
        self._write(np.ascontiguousarray(array), offset)
        if self._recent.limit:
            self._recent.put(archived.key, array)
        return archived

    def read(self, archived: "Archived") -> np.ndarray:
        """An array as it was written; one that is resident is not to be changed."""
        if not self._recent.limit:
            return self._read(archived)
        return self._recent.get(archived.key, lambda: self._read(archived))

    # --- checkpoints -----------------------------------------------------------------------

    def settle(self, folder: Path) -> "SettledArchive":
        """Put all that was written on the disk under a name in ``folder``; what to open it by.

        Raises:
            OutputError: the disk is full, or cannot be written.
        """
        try:
            if self._path is None or self._path.parent != folder:
                self._move(folder / f"archive-{uuid.uuid4().hex[:16]}")
            os.fsync(self._file.fileno())
        except OSError as error:
            raise self._unwritable(error) from error
        assert self._path is not None
        with self._lock:
            self._collect()
        self._releasing, self._withheld = self._releasing + self._withheld, []
        unused = [(o, size) for size, offsets in self._free.items() for o in offsets]
        resident, free = self._recent.limit, (*unused, *self._releasing)
        return SettledArchive(self._path.name, resident, self._end, self._next_key, free)

    def release(self) -> None:
        """The checkpoint that was written since ``settle`` is complete and replaces the last."""
        for offset, size in self._releasing:
            self._free.setdefault(size, []).append(offset)
        self._releasing = []

    @classmethod
    def reopened(cls, folder: Path, settled: "SettledArchive") -> "Archive":
        """The archive as it was when it was settled; what was written later is cut off.

        Raises:
            InputError: the file is missing or too short.
        """
        archive = cls(folder, settled.resident)
        path = folder / settled.name
        try:
            with path.open("r+b", buffering=0) as named:
                if os.fstat(named.fileno()).st_size < settled.end:
                    raise InputError(f"{path} is cut off.")
                named.truncate(settled.end)
                os.dup2(named.fileno(), archive._file.fileno())
        except OSError as error:
            raise InputError(f"{path} cannot be opened ({error.strerror or error}).") from error
        archive._path, archive._end, archive._next_key = path, settled.end, settled.next_key
        for offset, size in settled.free:
            archive._free.setdefault(size, []).append(offset)
        return archive

    def archived(
        self, key: int, offset: int, shape: tuple[int, ...], dtype: np.dtype
    ) -> "Archived":
        """An array that is in the file; its space is used again once nobody refers to it."""
        archived = Archived(self, key, offset, shape, dtype)
        size = math.prod(shape) * dtype.itemsize
        weakref.finalize(archived, self._gone.append, (key, offset, size))
        return archived

    def _move(self, path: Path) -> None:
        """Copy the file to another place, where it is from then on."""
        try:
            with path.open("x+b", buffering=0) as named:
                done = 0
                while done < self._end:
                    piece = os.pread(self._file.fileno(), min(_PIECE, self._end - done), done)
                    if not piece:  # something could not be written
                        break
                    done += os.pwrite(named.fileno(), piece, done)
                os.truncate(named.fileno(), self._end)
                os.dup2(named.fileno(), self._file.fileno())  # other threads notice nothing
        except OSError:
            path.unlink(missing_ok=True)
            raise
        self.folder, self._path = path.parent, path

    # --- the file --------------------------------------------------------------------------

    def _write(self, array: np.ndarray, offset: int) -> None:
        rest = memoryview(array.reshape(-1).view(np.uint8).data)
        try:
            while rest:
                done = os.pwrite(self._file.fileno(), rest, offset)
                rest, offset = rest[done:], offset + done
        except OSError as error:
            raise self._unwritable(error) from error

    def _read(self, archived: "Archived") -> np.ndarray:
        array = np.empty(archived.shape, archived.dtype)
        rest, offset = memoryview(array.reshape(-1).view(np.uint8).data), archived.offset
        while rest:
            done = os.preadv(self._file.fileno(), [rest], offset)
            if done == 0:
                raise OutputError(f"The archive in {self.folder} has been cut off.")
            rest, offset = rest[done:], offset + done
        return array

    def _collect(self) -> None:
        """Make the space of arrays that are gone free for others."""
        while self._gone:
            key, offset, size = self._gone.popleft()
            self._recent.drop(key)
            if self._path is None:
                self._free.setdefault(size, []).append(offset)
            else:
                self._withheld.append((offset, size))

    def _unwritable(self, error: OSError) -> OutputError:
        reason = error.strerror or str(error)
        remedy = (
            "name a folder on a larger disk in TMPDIR" if self._path is None
            else "give a folder on a larger disk for the results"
        )  # fmt: skip
        return OutputError(
            f"The keyframes of a long video cannot be kept in {self.folder} ({reason}); free some "
            f"space, or {remedy}."
        )


@dataclass(frozen=True)
class SettledArchive:
    """What a checkpoint says of an archive."""

    name: str
    """Of its file."""
    resident: int
    end: int
    """Bytes of the file."""
    next_key: int
    free: tuple[tuple[int, int], ...]
    """Offset and size of its unused pieces."""


class Archived:
    """An array in an archive."""

    __slots__ = ("__weakref__", "archive", "dtype", "key", "offset", "shape")

    def __init__(
        self, archive: Archive, key: int, offset: int, shape: tuple[int, ...], dtype: np.dtype
    ) -> None:
        self.archive = archive
        self.key = key
        self.offset = offset
        self.shape = shape
        self.dtype = dtype

    def load(self) -> np.ndarray:
        """The array as it was archived, which is not to be changed."""
        return self.archive.read(self)
