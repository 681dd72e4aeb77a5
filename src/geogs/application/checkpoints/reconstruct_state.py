"""The checkpoint of a reconstruction from known poses: its work after the depths."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from geogs.application.checkpoints.checkpoint import SavedState
from geogs.config import ReconstructConfig
from geogs.errors import InputError
from geogs.reconstruction import ReconstructionTable


@dataclass(frozen=True)
class ReconstructState:
    """Checkpoint record of ``geogs reconstruct``."""

    made_from: str
    """Fingerprint of settings and images."""
    work: ReconstructionTable


def fingerprint(config: ReconstructConfig, hold_out: int | None, images: Sequence[str]) -> str:
    """Sixteen digits that depend on the settings of the map and the names of its images."""
    parts = (config.seed, asdict(config.input), asdict(config.search), asdict(config.mapping))
    text = json.dumps([*parts, hold_out, list(images)], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def read_work(output: Path, made_from: str) -> ReconstructionTable:
    """Read the work of a checkpoint with the same fingerprint.

    Raises:
        InputError: there is nothing, it is damaged, or made from other settings or images.
    """
    saved = SavedState(output, ReconstructState)
    with saved.in_a_sentence():
        if saved.plain("made_from") != made_from:
            raise InputError("it was made with other settings or images; give the same ones")
    work: ReconstructionTable = saved.work("work")
    return work
