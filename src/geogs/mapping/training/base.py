"""What the mapper asks of whatever trains its map."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from torch import Tensor

from geogs.config import MappingConfig
from geogs.mapping.view import MapView
from geogs.splat.optimizer import LearningRates, MapOptimizer

Batch = list[tuple[MapView, list[MapView]]]
"""The views of one step, each with the partners that check it by their images."""

GRADIENT_LIMIT = 1e3
"""A disk whose gradient exceeds this has met a numerical accident (a nearly edge-on pixel)."""


@dataclass(frozen=True, slots=True)
class TrainingPlace:
    """How far a long training is."""

    steps: int = 0
    """Done."""
    total: int = 0
    """To be done in all."""
    seconds: float = 0.0
    """Spent."""


def learning_rates(config: MappingConfig, unit: float, factor: float = 1.0) -> LearningRates:
    """Adam steps in map units; ``unit`` is the map's typical depth."""
    return LearningRates(
        position=config.lr_position * unit * factor,
        quaternion=config.lr_quaternion * factor,
        log_scale=config.lr_scale * factor,
        opacity_logit=config.lr_opacity * factor,
    )


def draw_partners(
    view: MapView, views: dict[int, MapView], config: MappingConfig, random: np.random.Generator
) -> list[MapView]:
    """Some of a view's partners, at random."""
    ids = [i for i in view.partners if i in views]
    count = min(config.photo.per_step, len(ids))
    return [views[ids[i]] for i in random.choice(len(ids), count, replace=False)] if count else []


@runtime_checkable
class MapTrainer(Protocol):
    """Trains a map in place, and poses on it."""

    optimizer: MapOptimizer
    unit: float
    """Length in map units by which settings that are lengths are scaled."""

    def train(self, batches: Sequence[Batch], factors: Sequence[float] | None = None) -> None:
        """One Adam step per batch on its summed losses; ``factors`` scale all learning rates."""
        ...

    def refine_poses(
        self, active: list[MapView], views: dict[int, MapView], config: MappingConfig
    ) -> dict[int, Float[Tensor, "4 4"]]:
        """Poses of the active keyframes that agree better with the map; the earliest stays."""
        ...

    def forget_renders(self, views: Iterable[MapView]) -> None:
        """What the views showed of the map counts no more: it was moved."""
        ...
