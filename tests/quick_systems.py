"""Whole systems that are done in seconds, and their checkpoints."""

from dataclasses import dataclass, replace

from geogs.config import Config
from geogs.world.world import World


@dataclass
class Work:
    """A checkpoint of a world alone."""

    world: World


def quick_config(**mapping: int) -> Config:
    """Small maps, few planes, an early start; ``mapping`` sets what else is to be small."""
    c = Config()
    small = replace(
        c.mapping, render_long_edge=64, iterations=2,
        depth=replace(c.mapping.depth, planes=48), **mapping,
    )  # fmt: skip
    return replace(c, mapping=small, tracking=replace(c.tracking, init_keyframes=6))
