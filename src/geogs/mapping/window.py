"""Which views are trained together, and which check each other."""

import numpy as np

from geogs.config import MappingConfig, PhotoConfig
from geogs.depth.sweep_neighbors import misfit, parallax_degrees
from geogs.mapping.view import MapView


def draw_views(
    mapped: list[int], steps: int, config: MappingConfig, random: np.random.Generator
) -> list[list[int]]:
    """Ids of the views of some training steps: from the recent window plus random older keyframes.

    The older ones are drawn once for all steps, as they may have to be read from a file. With
    ``views_per_step`` 0 every step has the whole window and its history, as the paper sums them;
    otherwise that many of them at random, the newest in every third step.
    """
    window, older = mapped[-config.window :], mapped[: -config.window]
    drawn = min(config.history, len(older))
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


def choose_partners(
    view: MapView, others: list[MapView], depth: float, config: PhotoConfig
) -> list[int]:
    """Ids of the keyframes best placed to check a view's depth by photo-consistency, best first."""
    others = [o for o in others if o.id != view.id]
    if not others:
        return []
    parallax, turn = parallax_degrees(view.place, [o.place for o in others], depth)
    usable = (config.min_parallax < parallax) & (parallax < config.max_parallax)
    usable &= turn < config.max_view_angle
    scores = misfit(parallax, turn, config.parallax)
    scored = sorted((scores[i], o.id) for i, o in enumerate(others) if usable[i])
    return [i for _, i in scored[: config.candidates]]
