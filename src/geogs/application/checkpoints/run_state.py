"""The checkpoint of a run: all of its work so far, which survives Ctrl-C and kill."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch

from geogs.application.checkpoints.checkpoint import SavedState
from geogs.application.named_files import without_files_outside
from geogs.application.run_settings import RunSettings
from geogs.camera.shutter.shutter import Shutter
from geogs.errors import InputError
from geogs.io.sources.address import live_address
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.frame_source import ReadingPlace, Source
from geogs.slam import Slam
from geogs.world.world import World


@dataclass(frozen=True)
class RunMetadata:
    """Settings and inputs of a run, beside its state."""

    settings: RunSettings
    """Settings with absolute paths."""
    device: str
    """cpu or cuda."""
    fingerprint: str
    """Fingerprint of the source."""
    calibration: Calibration | None
    """Calibration estimated before the run; none if the source's own was used."""
    place: ReadingPlace = field(default_factory=ReadingPlace)
    """Reading position in the source."""
    shutter: Shutter = field(default_factory=Shutter)
    """Shutter, given or estimated before the run."""


@dataclass(frozen=True)
class RunState:
    """Checkpoint record of ``geogs run``."""

    metadata: RunMetadata
    world: World


def run_state(metadata: RunMetadata, slam: Slam, source: Source) -> RunState | None:
    """The present checkpoint record of a run; none before a map has been started."""
    if not slam.segments.keyframe_ids:
        return None
    return RunState(replace(metadata, place=source.place), slam.settled())


class SavedRun:
    """A run's checkpoint to resume from."""

    def __init__(self, output: Path) -> None:
        """Raises InputError if there is none, it is damaged, or another version wrote it."""
        self._saved = SavedState(output, RunState)
        self.metadata: RunMetadata = self._saved.plain("metadata")
        with self._saved.in_a_sentence():
            self.settings = self._trusted(output)
            """Settings of the run; an untrusted checkpoint's files elsewhere are left out."""

    def _trusted(self, output: Path) -> RunSettings:
        begun = self.metadata.settings
        if any(map(live_address, begun.source)):  # such runs write no checkpoint
            raise InputError("it names a live source, which cannot be continued")
        return begun if self._saved.is_own else without_files_outside(begun, output)

    @contextmanager
    def world(self, device: torch.device) -> Iterator[World]:
        """Restore the run's world; building a system in the block may raise InputError."""
        world = self._saved.work("world", device)
        with self._saved.in_a_sentence():
            yield world

    def calibrated(self, source: Source) -> Source:
        """The source with the run's calibration. Raises InputError if its files have changed."""
        if source.fingerprint() != self.metadata.fingerprint:
            raise InputError(
                f"{source.name} is not what it was when the run began (other files, or other "
                "sizes); put it back, or start anew without --resume."
            )
        found = self.metadata.calibration
        calibrated = source if found is None else source.with_calibration(found)
        return calibrated.with_shutter(self.metadata.shutter)
