"""Selection of the views of training steps, and learning rates."""

from collections.abc import Mapping, Sequence

import numpy as np

from geogs.config import MappingConfig
from geogs.mapping.keyframe_views import MapView
from geogs.splat.optimizer import LearningRates

Batch = list[tuple[MapView, list[MapView]]]
"""The views of one step, each with the partners that check it by their images."""

LR_QUATERNION, LR_SCALE, LR_OPACITY = 4e-3, 0.08, 0.1
"""Adam steps of quaternions, log scales and opacity logits, which have no unit of length."""
HISTORY = 2
"""Older keyframes drawn at random into each window, as in the paper, so that none is forgotten."""
GRADIENT_LIMIT = 1e3
"""Gradient of a disk above which it is a numerical failure (of a nearly edge-on pixel)."""


def learning_rates(config: MappingConfig, unit: float, factor: float = 1.0) -> LearningRates:
    """Adam steps in map units; ``unit`` is the map's typical depth."""
    return LearningRates(
        position=config.lr_position * unit * factor,
        quaternion=LR_QUATERNION * factor,
        log_scale=LR_SCALE * factor,
        opacity_logit=LR_OPACITY * factor,
    )


def draw_views(
    mapped: list[int], steps: int, config: MappingConfig, random: np.random.Generator
) -> list[list[int]]:
    """Draw the views of some training steps: from the window and from random older keyframes.

    The older ones are drawn once for all steps, as they may have to be read from a file. With
    ``views_per_step`` 0 every step has the whole window and its history, as the paper sums them;
    otherwise that many of them at random, the newest in every third step.
    """
    window = mapped[-config.window :]
    older = mapped[: -config.window]
    drawn = min(HISTORY, len(older))
    history = [older[i] for i in random.choice(len(older), drawn, replace=False)] if drawn else []
    pool = window + history
    if config.views_per_step <= 0:
        return [pool] * steps
    views = []
    for step in range(steps):
        newest = [mapped[-1]] if step % 3 == 0 else []
        more = max(0, min(config.views_per_step, len(pool)) - len(newest))
        rest = [pool[i] for i in random.choice(len(pool), more, replace=False)]
        views.append(list(dict.fromkeys(newest + rest)))
    return views


def draw_batch(
    ids: Sequence[int],
    views: Mapping[int, MapView],
    config: MappingConfig,
    random: np.random.Generator,
) -> Batch:
    """The given views, each with some of its partners at random."""
    return [(views[i], _draw_partners(views[i], views, config, random)) for i in ids]


def _draw_partners(
    view: MapView, views: Mapping[int, MapView], config: MappingConfig, random: np.random.Generator
) -> list[MapView]:
    ids = [i for i in view.row.partners if i in views]
    count = min(config.photo.per_step, len(ids))
    return [views[ids[i]] for i in random.choice(len(ids), count, replace=False)] if count else []
