"""``checkpoint/`` in a run's folder: all of its work so far, which survives Ctrl-C and kill.

``state`` refers to arrays in the archives beside it, which only grow or are written where the last
complete state refers to nothing. A new state replaces the last when it is complete.
"""

import time
import zlib
from collections.abc import Generator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from io import BufferedReader
from pathlib import Path

import geogs
from geogs.application.checkpoint import next_due
from geogs.application.checkpoint_folder import CheckpointFolder
from geogs.application.progress import RunProgress
from geogs.application.settings import RunSettings
from geogs.errors import InputError, OutputError
from geogs.io.sources.base import ReadingPlace
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.several import JointPlace, SeveralSources
from geogs.io.sources.sniff import Stream
from geogs.io.writers.atomic import atomic_file
from geogs.slam import Slam
from geogs.slam_state import ByteSink, read_record, read_slam, write_record, write_slam
from geogs.types import Frame

_TITLE = f"geogs run checkpoint 1, geogs {geogs.__version__}\n".encode()
_PIECE = 1 << 20
_CHECKSUM_BYTES = 4
_OURS = frozenset({
    ("geogs.application.settings", "RunSettings"), ("geogs.application.run_checkpoint", "RunFacts"),
    ("geogs.io.sources.base", "ReadingPlace"), ("geogs.io.sources.calibration", "Calibration"),
    ("geogs.io.sources.calibration", "Refinement"), ("geogs.io.sources.several", "JointPlace"),
    ("geogs.io.sources.several", "SourceSpan"),
})  # fmt: skip
"""Classes of the facts."""


@dataclass(frozen=True)
class RunFacts:
    """What a run is made of, beside its state."""

    settings: RunSettings
    """With absolute paths."""
    device: str
    """cpu or cuda."""
    fingerprint: str
    """Of the source."""
    calibration: Calibration | None
    """Found before the run; none if the source's own was taken."""
    place: ReadingPlace | JointPlace = field(default_factory=ReadingPlace)
    """How far the source has been read."""


class RunCheckpoint:
    """Writes the checkpoint of a run, now and then."""

    def __init__(self, output: Path, facts: RunFacts, every: float, progress: RunProgress) -> None:
        """Every so many seconds it is written, never if 0."""
        self.folder = checkpoint_folder(output)
        self._facts = facts
        self._every = every
        self._progress = progress
        self._due = time.perf_counter() + every

    def after_frame(self, slam: Slam, source: Stream) -> None:
        """Write it when its time has come."""
        if self._every > 0 and time.perf_counter() >= self._due:
            self.write(slam, source)

    def write(self, slam: Slam, source: Stream) -> bool:
        """Write it, if a map has been started; where that fails, say so once and go on without."""
        if self._every <= 0 or not slam.segments.keyframe_ids:
            return False
        start = time.perf_counter()
        try:
            with slam.stopwatch("checkpoints"):
                self._write(slam, replace(self._facts, place=source.place))
        except OutputError as error:
            self._progress.write(f"No more checkpoints: {error}")
            self._every = 0.0
        self._due = next_due(start, self._every)
        return self._every > 0

    def remove(self) -> None:
        """After success."""
        with suppress(OSError):
            for path in self.folder.iterdir():
                path.unlink()
            self.folder.rmdir()

    def _write(self, slam: Slam, facts: RunFacts) -> None:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{self.folder} cannot be made ({error.strerror}).") from error
        with atomic_file(self.folder / "state") as stream:
            checked = _CheckedWriter(stream)
            checked.write(_TITLE)
            write_record(checked, facts)
            archives = write_slam(checked, slam, CheckpointFolder(self.folder))
            stream.write(checked.sum.to_bytes(_CHECKSUM_BYTES, "big"))
        used = {archive.name for archive in archives}
        for archive in archives:
            archive.release()
        for path in self.folder.glob("archive-*"):
            if path.name not in used:
                path.unlink(missing_ok=True)


class SavedRun:
    """A checkpoint to go on from."""

    def __init__(self, output: Path) -> None:
        """Raises InputError if there is none, it is damaged, or another version wrote it."""
        self.folder = checkpoint_folder(output)
        self._path = self.folder / "state"
        if not self._path.is_file():
            raise InputError(
                f"There is nothing to resume: {self._path} does not exist; give the folder of a "
                "run that was interrupted."
            )
        try:
            with self._path.open("rb") as stream:
                self._check(stream)
                self.facts: RunFacts = read_record(stream, RunFacts, more=_OURS)
                self._begin = stream.tell()
        except (OSError, InputError) as error:
            raise self._unusable(error) from error

    def restore(self, slam: Slam) -> None:
        """Give a new system the state. Raises InputError if that cannot be."""
        try:
            with self._path.open("rb") as stream:
                stream.seek(self._begin)
                read_slam(stream, slam, CheckpointFolder(self.folder))
        except (OSError, InputError) as error:
            raise self._unusable(error) from error

    def calibrated(self, source: Stream) -> Stream:
        """The source as the run read it. Raises InputError if its files are not what they were."""
        if source.fingerprint() != self.facts.fingerprint:
            raise InputError(
                f"{source.name} is not what it was when the run began (other files, or other "
                "sizes); put it back, or start anew without --resume."
            )
        found = self.facts.calibration
        return source if found is None else source.with_calibration(found)

    def _check(self, stream: BufferedReader) -> None:
        """Leave the stream behind the title if title and checksum are right."""
        title = stream.readline(200)
        if title != _TITLE:
            ours = title.startswith(b"geogs run checkpoint")
            raise InputError("written by another version" if ours else "no checkpoint of geogs")
        stream.seek(0)
        left = self._path.stat().st_size - _CHECKSUM_BYTES
        checksum = 0
        while left > 0 and (piece := stream.read(min(_PIECE, left))):
            checksum, left = zlib.crc32(piece, checksum), left - len(piece)
        if stream.read() != checksum.to_bytes(_CHECKSUM_BYTES, "big"):
            raise InputError("its content has changed, or is cut off")
        stream.seek(len(_TITLE))

    def _unusable(self, error: Exception) -> InputError:
        return InputError(f"{self._path} cannot be used ({error}); start anew without --resume.")


def checkpoint_folder(output: Path) -> Path:
    """Where a run's checkpoint lies."""
    return output / "checkpoint"


def has_checkpoint(output: Path) -> bool:
    """Whether a run in a folder could be gone on with."""
    return (checkpoint_folder(output) / "state").is_file()


def frames_after(source: Stream, place: ReadingPlace | JointPlace) -> Generator[Frame, None, None]:
    """The frames of a source after a place in it. Raises InputError if there cannot be one."""
    if isinstance(source, SeveralSources):
        if isinstance(place, JointPlace):
            return source.frames_after(place)
    elif isinstance(place, ReadingPlace):
        return source.frames_after(place)
    raise InputError(f"{source.name} is not what it was when the run began.")


class _CheckedWriter:
    """Passes on what is written, and sums it up."""

    def __init__(self, stream: ByteSink) -> None:
        self._stream = stream
        self.sum = 0

    def write(self, data: bytes) -> int:
        """As of a file."""
        self.sum = zlib.crc32(data, self.sum)
        return self._stream.write(data)
