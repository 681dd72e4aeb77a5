"""Kinds of scenes, and how often each is filmed."""

from jaxtyping import Int
from torch import Tensor

from geogs_synth.clips.options import SceneShares
from geogs_synth.draw import Draw

USUAL, SHAKEN, PEOPLE, PAPERED, BARE, STREET = range(6)
"""A still room and a shutter that opens for a moment; a camera that moves while it looks; people
who walk; walls of one pattern that repeats; next to no texture; a street."""
NAMES = ("usual", "shaken", "people", "papered", "bare", "street")
"""Of the kinds, as in :class:`SceneShares`."""


def only_scene(name: str) -> SceneShares:
    """Scenes of one kind."""
    return SceneShares(**{n: float(n == name) for n in NAMES})


def draw_kinds(draw: Draw, shares: SceneShares, clips: int) -> Int[Tensor, "b"]:
    """The kind of each clip."""
    return draw.choose([getattr(shares, name) for name in NAMES], clips)
