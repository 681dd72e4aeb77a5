"""What a trainer asks of whatever is taught: a network, its batches, its loss, its examination."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from geogs_train.training_options import TrainingSchedule

Panels = tuple[tuple[str, tuple[str, ...], bool], ...]
"""Pictures of scores: title, names of scores, whether on a logarithmic scale."""


@dataclass(frozen=True)
class Worker:
    """This process among those that train together, one for each device."""

    device: torch.device
    rank: int = 0
    count: int = 1


@runtime_checkable
class ValidationScores(Protocol):
    """What a validation says: a dataclass of numbers."""

    def line(self) -> str:
        """On one line."""
        ...


@runtime_checkable
class Examination(Protocol):
    """The fixed validation set."""

    def score(self, network: Any) -> Any:
        """Scores of a network."""
        ...


@runtime_checkable
class Course(Protocol):
    """What is taught."""

    weights: str
    """Name of the file of trained weights."""
    curves: Panels
    """What is drawn of the scores."""

    @property
    def options(self) -> TrainingSchedule:
        """The settings."""
        ...

    @property
    def recordable(self) -> bool:
        """Whether loss and gradients may be recorded as a CUDA graph."""
        ...

    def network(self) -> Any:
        """With random weights, on the CPU."""
        ...

    def compile(self, network: Any) -> None:
        """Compile the parts of a network that are worth it."""
        ...

    def batch(self, step: int, progress: float) -> Any:
        """What a step learns from, when such a fraction of the run is done; the same whenever it is
        asked for."""
        ...

    def loss(self, network: Any, batch: Any) -> Float[Tensor, ""]:
        """The loss of a batch; nothing random."""
        ...

    def examination(self, batches: int) -> Examination:
        """The validation set."""
        ...

    def load(self, path: Path) -> nn.Module:
        """The network of a file of weights."""
        ...

    def export(self, network: Any, path: Path, step: int, scores: Any) -> None:
        """Write weights as they are shipped."""
        ...

    def close(self) -> None:
        """End what was begun."""
        ...
