"""Plain records as a checkpoint would bring them back."""

from typing import TypeVar

from geogs.world.pack import pack, unpack

R = TypeVar("R")


def copied(record: R) -> R:
    """A record taken apart and made again, which shares nothing but archives."""
    packed = pack(type(record), record)
    made: R = unpack(type(record), packed.values, packed.arrays, packed.archives)
    return made
