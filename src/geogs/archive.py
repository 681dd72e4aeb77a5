"""Arrays that leave the memory for a file until they are wanted again.

A long video has more keyframes than fit into memory, and seldom are old ones looked at. The file
is read and written at offsets and never mapped, so nothing of it counts as memory of the process.
"""

import os
import tempfile
import threading
import weakref
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np

from geogs.errors import OutputError

V = TypeVar("V")


class Recent(Generic[V]):
    """The values used last, up to a number of them; others are made again. For any thread."""

    def __init__(self, count: int) -> None:
        self.count = count
        self._values: OrderedDict[Hashable, V] = OrderedDict()
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._values)

    def put(self, key: Hashable, value: V) -> None:
        """Keep a value as the last used; the one not used for longest may go."""
        with self._lock:
            self._values[key] = value
            self._values.move_to_end(key)
            while len(self._values) > self.count:
                self._values.popitem(last=False)

    def get(self, key: Hashable, make: Callable[[], V]) -> V:
        """The value of a key, made where it is no longer kept."""
        with self._lock:
            if key in self._values:
                self._values.move_to_end(key)
                return self._values[key]
        value = make()
        self.put(key, value)
        return value

    def drop(self, key: Hashable) -> None:
        """Forget a value."""
        with self._lock:
            self._values.pop(key, None)


class Archive:
    """A file of arrays of any shape and type, for as long as the process lasts.

    It lies in ``folder``, or where the system keeps temporary files (``TMPDIR``), has no name there
    and so vanishes with the process, however that ends. The last ``resident`` arrays written or
    read stay in memory as well. Space of arrays that nobody refers to any more is used again.
    """

    def __init__(self, folder: Path | str | None = None, resident: int = 0) -> None:
        self.folder = Path(folder or tempfile.gettempdir())
        self._recent: Recent[np.ndarray] = Recent(resident)
        self._free: dict[int, list[int]] = {}
        """Offsets of unused pieces, by their size."""
        self._gone: deque[tuple[int, int, int]] = deque()
        """Key, offset and size of what nobody refers to any more; collected without a lock."""
        self._end = self._next_key = 0
        self._lock = threading.Lock()
        try:
            self._file = tempfile.TemporaryFile(dir=self.folder, buffering=0)  # noqa: SIM115
        except OSError as error:
            raise self._unwritable(error) from error

    @property
    def size(self) -> int:
        """Bytes of the file."""
        return self._end

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
            archived = Archived(self, self._next_key, offset, array.shape, array.dtype)
        weakref.finalize(archived, self._gone.append, (archived.key, offset, array.nbytes))
        self._write(np.ascontiguousarray(array), offset)
        if self._recent.count:
            self._recent.put(archived.key, array)
        return archived

    def read(self, archived: "Archived") -> np.ndarray:
        """An array as it was written; one that is resident is not to be changed."""
        if not self._recent.count:
            return self._read(archived)
        return self._recent.get(archived.key, lambda: self._read(archived))

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
            self._free.setdefault(size, []).append(offset)

    def _unwritable(self, error: OSError) -> OutputError:
        reason = error.strerror or str(error)
        return OutputError(
            f"The keyframes of a long video cannot be kept in {self.folder} ({reason}); free some "
            "space, or name a folder on a larger disk in TMPDIR."
        )


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
