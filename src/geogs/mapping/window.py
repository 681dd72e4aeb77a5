"""Which views are trained together, and which check each other."""

import numpy as np

from geogs.config import MappingConfig, PhotoConfig
from geogs.mapping.sweep_neighbors import misfit, parallax_degrees
from geogs.mapping.view import MapView


def draw_views(
    mapped: list[int], step: int, config: MappingConfig, random: np.random.Generator
) -> list[int]:
    """Ids of the views of one training step: from the recent window plus random older keyframes.

    With ``views_per_step`` 0 the whole window and its history, as the paper sums them; otherwise
    that many of them at random, the newest in every third step.
    """
    window, older = mapped[-config.window :], mapped[: -config.window]
    drawn = min(config.history, len(older))
    history = [older[i] for i in random.choice(len(older), drawn, replace=False)] if drawn else []
    pool = window + history
    if config.views_per_step <= 0:
        return pool
    newest = [mapped[-1]] if step % 3 == 0 else []
    more = max(0, min(config.views_per_step, len(pool)) - len(newest))
    rest = [pool[i] for i in random.choice(len(pool), more, replace=False)]
    return list(dict.fromkeys(newest + rest))


def choose_partners(
    view: MapView, others: list[MapView], depth: float, config: PhotoConfig
) -> list[int]:
    """Ids of the keyframes best placed to check a view's depth by photo-consistency, best first."""
    others = [o for o in others if o.id != view.id]
    if not others:
        return []
    views = [o.depth_view for o in others]
    parallax, turn = parallax_degrees(view.depth_view, views, depth)
    usable = (config.min_parallax < parallax) & (parallax < config.max_parallax)
    usable &= turn < config.looking_within
    scores = misfit(parallax, turn, config.parallax)
    scored = sorted((scores[i], o.id) for i, o in enumerate(others) if usable[i])
    return [i for _, i in scored[: config.candidates]]
