"""The checkpoint of a reconstruction from known poses: its work after the depths."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from geogs.application.checkpoints.checkpoint import Checkpoint, SavedState
from geogs.application.progress import RunProgress
from geogs.config import ReconstructConfig
from geogs.errors import InputError
from geogs.reconstruction import Reconstruction, ReconstructionState


@dataclass(frozen=True)
class ReconstructState:
    """What is stored of ``geogs reconstruct``."""

    made_from: str
    """Fingerprint of settings and images."""
    work: ReconstructionState


def fingerprint(config: ReconstructConfig, hold_out: int | None, images: Sequence[str]) -> str:
    """Sixteen digits that change with any setting of the map and with the names of its images."""
    parts = (config.seed, asdict(config.input), asdict(config.search), asdict(config.mapping))
    text = json.dumps([*parts, hold_out, list(images)], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


class ReconstructCheckpoint(Checkpoint):
    """Written when the depths are done, then now and then while the map is trained."""

    def __init__(self, output: Path, made_from: str, every: float, progress: RunProgress) -> None:
        """``made_from`` is the fingerprint; every so many seconds it is written, never if 0."""
        super().__init__(output, every, progress)
        self._output = output
        self._made_from = made_from
        self._has_work = False

    def report(self, stage: str, scene: Reconstruction) -> None:
        """At a report of progress: write it when the depths are done, then when its time comes."""
        if stage not in ("growing", "training"):
            return
        self._has_work = True
        if stage == "growing" or self.is_due:
            self.write(scene)

    def write(self, scene: Reconstruction) -> bool:
        """Write it, if there is something to go on from; whether it has been."""
        if not self._has_work:
            return False
        return self.write_state(lambda: ReconstructState(self._made_from, scene.state()))

    def read(self) -> ReconstructionState:
        """The work to go on from; says where that is.

        Raises:
            InputError: there is none, it is damaged, or made from other settings or images.
        """
        work = read_work(self._output, self._made_from)
        place = work.mapper.place
        done = f"step {place.steps} of {place.total}" if place.steps else "the depths"
        self._progress.write(f"Going on after {done}, {work.seconds:.0f} s into the work.")
        return work


def read_work(output: Path, made_from: str) -> ReconstructionState:
    """What was written into the results with the same fingerprint.

    Raises:
        InputError: there is nothing, it is damaged, or made from other settings or images.
    """
    saved = SavedState(output, ReconstructState)
    with saved.in_a_sentence():
        if saved.facts("made_from") != made_from:
            raise InputError("it was made with other settings or images; give the same ones")
    return saved.work("work")
