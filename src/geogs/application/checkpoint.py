"""``checkpoint.safetensors``: a reconstruction's work so far, which survives Ctrl-C and kill."""

import hashlib
import json
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from geogs.application.progress import RunProgress
from geogs.config import ReconstructConfig
from geogs.errors import InputError, OutputError
from geogs.io.writers.atomic import atomic_file
from geogs.mapping.state import DepthState, DiskState, MapperState
from geogs.mapping.training.base import TrainingPlace
from geogs.reconstruction import Reconstruction, ReconstructionState
from geogs.splat.map import DiskParameters

FORMAT = "geogs-checkpoint-1"
# Checkpoints may take this part of the time.
_WRITING_SHARE = 0.05


def fingerprint(config: ReconstructConfig, hold_out: int | None, images: Sequence[str]) -> str:
    """Sixteen digits that change with any setting of the map and with the names of its images."""
    parts = (config.seed, asdict(config.input), asdict(config.search), asdict(config.mapping))
    text = json.dumps([*parts, hold_out, list(images)], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


class Checkpoint:
    """The file in a result's folder, written now and then while the map is trained."""

    def __init__(self, output: Path, made_from: str, every: float, progress: RunProgress) -> None:
        """``made_from`` is the fingerprint; every so many seconds it is written, never if 0."""
        self.path = output / "checkpoint.safetensors"
        self._made_from = made_from
        self._every = every
        self._progress = progress
        self._due: float | None = None

    def report(self, stage: str, scene: Reconstruction) -> None:
        """At a report of progress: write it when the depths are done, then when its time comes."""
        if self._every <= 0 or stage not in ("growing", "training"):
            return
        now = time.perf_counter()
        if self._due is None:  # resumed work begins with its training
            self._due = now + (0.0 if stage == "growing" else self._every)
        if now >= self._due:
            self.write(scene)

    def write(self, scene: Reconstruction) -> bool:
        """Write it, if there is something to go on from; where that fails, say so and go on."""
        if self._every <= 0 or self._due is None:
            return False
        start = time.perf_counter()
        try:
            write_checkpoint(self.path, scene.state(), self._made_from)
        except OutputError as error:
            self._progress.write(f"No checkpoint: {error}")
            self._every = 0.0
        self._due = next_due(start, self._every)
        return self._every > 0

    def read(self) -> ReconstructionState:
        """The work to go on from; says where that is.

        Raises:
            InputError: there is none, it is damaged, or made from other settings or images.
        """
        state = read_checkpoint(self.path, self._made_from)
        place = state.mapper.trained
        done = f"step {place.steps} of {place.total}" if place.steps else "the depths"
        self._progress.write(f"Going on after {done}, {state.seconds:.0f} s into the work.")
        return state

    def remove(self) -> None:
        """After success."""
        self.path.unlink(missing_ok=True)


def next_due(start: float, every: float) -> float:
    """When the next checkpoint is due, after one that was begun at ``start``; both seconds."""
    now = time.perf_counter()
    return now + max(every, (now - start) / _WRITING_SHARE)


def write_checkpoint(path: Path, state: ReconstructionState, made_from: str) -> None:
    """Write a state, completely or not at all. Raises OutputError if that fails."""
    depths, disks, place = state.mapper.depths, state.mapper.disks, state.mapper.trained
    tensors = {
        "origin": torch.from_numpy(state.origin),
        **{f"depths.{name}": x for name, x in vars(depths).items()},
        **{f"disks.{name}": getattr(disks, name) for name in ("keyframe_id", "steps", "seen")},
    }
    for group in ("parameters", "first", "second"):
        values: DiskParameters = getattr(disks, group)
        tensors |= {f"{group}.{name}": x for name, x in values._asdict().items()}
    numbers = {"unit": state.unit, "seconds": state.seconds, "place": asdict(place)}
    header = {"format": FORMAT, "made_from": made_from, "numbers": json.dumps(numbers)}
    with atomic_file(path) as stream:
        stream.write(save({k: x.contiguous() for k, x in tensors.items()}, metadata=header))


def read_checkpoint(path: Path, made_from: str) -> ReconstructionState:
    """Read what was written with the same fingerprint.

    Raises:
        InputError: it is missing, damaged, or made from other settings or images.
    """
    if not path.is_file():
        raise InputError(f"There is nothing to resume: {path} does not exist; leave out --resume.")
    try:
        with safe_open(str(path), framework="pt") as file:
            header = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise InputError(f"{path} is damaged ({error}); leave out --resume.") from error
    if header.get("format") != FORMAT:
        raise InputError(f"{path} is no checkpoint of this version; leave out --resume.")
    if header["made_from"] != made_from:
        raise InputError(
            f"{path} was made with other settings or images; give the same ones to go on from it, "
            "or leave out --resume to start anew."
        )
    numbers = json.loads(header["numbers"])
    depths = DepthState(**_group(tensors, "depths"))
    parameters, first, second = (
        DiskParameters(**_group(tensors, k)) for k in ("parameters", "first", "second")
    )
    counts = _group(tensors, "disks")
    disks = DiskState(
        parameters, first, second, counts["keyframe_id"], counts["steps"], counts["seen"]
    )
    mapper = MapperState(depths, disks, TrainingPlace(**numbers["place"]))
    origin = tensors["origin"].numpy()
    return ReconstructionState(mapper, origin, numbers["unit"], numbers["seconds"])


def _group(tensors: dict[str, Tensor], name: str) -> dict[str, Tensor]:
    """The tensors of one part, by the names of its fields."""
    start = f"{name}."
    return {k.removeprefix(start): x for k, x in tensors.items() if k.startswith(start)}
