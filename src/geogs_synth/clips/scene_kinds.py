"""Kinds of scenes, and how often each is filmed."""

from jaxtyping import Int
from torch import Tensor

from geogs_synth.clips.room_options import SceneWeights
from geogs_synth.draw import Draw

USUAL, SHAKEN, PEOPLE, PAPERED, BARE, STREET = range(6)
"""A still room and a shutter that opens for a moment; a camera that moves while it looks; people
who walk; walls of one pattern that repeats; next to no texture; a street."""
NAMES = ("usual", "shaken", "people", "papered", "bare", "street")
"""Names of the kinds, as in :class:`SceneWeights`."""


def only_scene(name: str) -> SceneWeights:
    """Scenes of one kind."""
    return SceneWeights(**{n: float(n == name) for n in NAMES})


def draw_kinds(draw: Draw, weights: SceneWeights, clips: int) -> Int[Tensor, "b"]:
    """The kind of each clip."""
    return draw.choose([getattr(weights, name) for name in NAMES], clips)
