"""Furnished rooms, made and lit once in a process; that takes longer than most tests of them."""

import functools

from geogs_synth.places.room import make_room
from geogs_synth.raycast.raycaster import Raycaster


@functools.cache
def lit_room(seed: int) -> Raycaster:
    """Renderer of the room of a seed, by one thread. Nobody may change its scene."""
    return Raycaster(make_room(seed), threads=1)
