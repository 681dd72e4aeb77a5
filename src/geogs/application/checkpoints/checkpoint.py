"""Checkpoints: the state of some work in ``checkpoint/`` of its results, to resume from.

The state, a record, is split (:mod:`geogs.world.pack`) into JSON and a safetensors
file; large arrays of old keyframes lie in archives beside them, which only grow or are written
where the last complete state refers to nothing. Objects of the process (device, flow operator,
prior, kernels, threads) are not stored: the reading process has its own.
"""

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Generic, TypeVar, get_type_hints

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save

from geogs.application.checkpoints.folder import FORMAT, CheckpointFolder
from geogs.application.machine.device import is_gpu_failure
from geogs.application.progress.run_progress import RunProgress
from geogs.errors import InputError, OutputError
from geogs.guard.directory import identity
from geogs.guard.documents import UNUSABLE, in_short
from geogs.stopwatch import Stopwatch
from geogs.version import __version__
from geogs.world.archive import Archive, SettledArchive
from geogs.world.kinds import schema
from geogs.world.pack import pack, unpack

S = TypeVar("S")

_UNUSABLE = (OSError, InputError, SafetensorError, MemoryError, RuntimeError, *UNUSABLE)
"""Errors of reading an untrusted file."""


class Checkpoint:
    """Writes the state of some work at intervals; a failure is reported once, and work goes on."""

    def __init__(
        self,
        output: Path,
        every: float,
        state: Callable[[], object | None],
        progress: RunProgress,
        stopwatch: Stopwatch,
    ) -> None:
        """Write into a folder of results every ``every`` seconds, never if 0.

        ``state`` gives the record to write; none while there is nothing to resume from.
        """
        self._output = output
        self._place = identity(output)
        self._folder = checkpoint_folder(output)
        self._every = every
        self._state = state
        self._progress = progress
        self._stopwatch = stopwatch
        self._due = time.perf_counter() + every
        self.is_complete = False
        """Whether the last write was complete."""

    def write_if_due(self) -> None:
        """Write the state if the interval has passed."""
        if self._every > 0 and time.perf_counter() >= self._due:
            self.write()

    def write(self) -> bool:
        """Write the present state. Returns whether its checkpoint is complete."""
        with self._stopwatch("checkpoints"):
            self.is_complete = self._write()
        return self.is_complete

    def _write(self) -> bool:
        state = self._state() if self._every > 0 else None
        if state is None:
            return False
        start = time.perf_counter()
        try:
            if identity(self._output) != self._place:
                raise OutputError(f"{self._output} is another folder than at the beginning.")
            write_checkpoint(self._folder, state)
        except OutputError as error:
            self._progress.write(f"No more checkpoints: {error}")
            self._every = 0.0
        now = time.perf_counter()
        # Fraction of the time of the work that writing checkpoints may take.
        self._due = now + max(self._every, (now - start) / 0.05)
        return self._every > 0

    def remove(self) -> None:
        """Delete all that geogs wrote there, after success."""
        self._folder.remove()


class SavedState(Generic[S]):
    """A complete checkpoint of work whose state is a record of some kind."""

    def __init__(self, output: Path, kind: type[S]) -> None:
        """Raises InputError if there is none, it is damaged, or another version wrote it."""
        self._kinds = get_type_hints(kind)
        self._folder = checkpoint_folder(output)
        with self.in_a_sentence():
            manifest = self._folder.manifest()
        if manifest is None or not manifest.state:
            raise InputError(
                f"There is nothing to resume: no complete checkpoint is in {self._folder.path}; "
                "start anew without --resume."
            )
        with self.in_a_sentence():
            if (manifest.format, manifest.geogs) != (FORMAT, __version__):
                raise InputError(f"geogs {manifest.geogs} wrote it, another version than this")
            if manifest.schema != schema(kind):
                raise InputError("it is of another command, or another version wrote it")
            self._manifest = manifest
            self.is_own = manifest.is_own
            """Whether this user is known to have made it."""
            self._values = json.loads(self._read("json"))

    def plain(self, name: str) -> Any:
        """A field of the state without any array. Raises InputError if it is damaged."""
        with self.in_a_sentence():
            return unpack(self._kinds[name], self._values["state"].get(name), {}, {}, name=name)

    def work(self, name: str, device: torch.device | str = "cpu") -> Any:
        """A field of the state, once; tensors that were on a GPU go to ``device``.

        Raises:
            InputError: it does not match the types of the kind, or an array has changed.
        """
        with self.in_a_sentence():
            arrays = load(self._read("safetensors"))
            folder = self._folder
            settled = unpack(dict[str, SettledArchive], self._values["archives"], {}, {})
            for foreign in sorted(settled.keys() - self._manifest.files):
                raise InputError(f"{foreign[:40]!r} is none of its files")
            archives = {n: Archive.reopened(folder, n, s) for n, s in settled.items()}
            values = self._values["state"].pop(name)
            return unpack(self._kinds[name], values, arrays, archives, device, name)

    @contextmanager
    def in_a_sentence(self) -> Iterator[None]:
        """Turn errors of using the checkpoint into an InputError with the remedy."""
        try:
            yield
        except _UNUSABLE as error:
            if is_gpu_failure(error):
                raise  # the checkpoint is well
            reason = in_short(error)
            raise InputError(
                f"{self._folder.path} cannot be used ({reason}); start anew without --resume."
            ) from error

    def _read(self, ending: str) -> bytes:
        """Content of the state's file with this ending."""
        files = self._manifest.state
        (name,) = (name for name in files if name.endswith(f".{ending}"))
        return self._folder.read(name, files[name])


def write_checkpoint(folder: CheckpointFolder, state: object) -> None:
    """Replace the last record, completely or not at all. Raises OutputError."""
    kind = type(state)
    packed = pack(kind, state)
    with folder.replaced(schema(kind), packed.archives) as write:
        settled = {name: archive.settle(folder) for name, archive in packed.archives.items()}
        archives = pack(dict[str, SettledArchive], settled).values
        write("json", json.dumps({"archives": archives, "state": packed.values}).encode())
        write("safetensors", save(packed.arrays))
    for archive in packed.archives.values():
        archive.release()


def checkpoint_folder(output: Path) -> CheckpointFolder:
    """The checkpoint of a folder of results."""
    return CheckpointFolder(output / "checkpoint")


def has_checkpoint(output: Path, kind: type | None = None) -> bool:
    """Whether the work of a folder can be resumed; with ``kind``, whether its state is of that."""
    try:
        manifest = checkpoint_folder(output).manifest()
    except (OSError, InputError):
        return False
    if manifest is None or not manifest.state:
        return False
    return kind is None or manifest.schema == schema(kind)
