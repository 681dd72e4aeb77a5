"""What is known in metres, as ``--scale-from`` says it."""

import re
from dataclasses import dataclass

from geogs.errors import InputError

_NUMBER = r"([-+]?[0-9]*\.?[0-9]+(?:[eE][-+]?[0-9]+)?)"
_DISTANCE = re.compile(rf"(\d+):{_NUMBER},{_NUMBER},{_NUMBER},{_NUMBER}={_NUMBER}m?")
_TAG = re.compile(rf"aruco:(DICT_\w+):{_NUMBER}m?")
_HEIGHT = re.compile(rf"height:{_NUMBER}m?")
LONGEST = 1e6
"""Metres of anything that is known."""
HOW = (
    "give FRAME:u1,v1,u2,v2=1.25m, several of them with semicolons, aruco:DICT_5X5_50:0.12, "
    "height:1.6 or sensor"
)
"""What a mistake is answered with."""


@dataclass(frozen=True)
class KnownDistance:
    """Two pixels of a frame whose points are so far from each other."""

    frame: int
    """Number of the frame in the source's selection, from 0."""
    first: tuple[float, float]
    """Column and row in the image as it came, upright."""
    second: tuple[float, float]
    metres: float


@dataclass(frozen=True)
class KnownDistances:
    """Some of them, which vote."""

    each: tuple[KnownDistance, ...]


@dataclass(frozen=True)
class TagSize:
    """Square tags of one family, whose black squares have so long a side."""

    family: str
    """As OpenCV calls its dictionary."""
    metres: float


@dataclass(frozen=True)
class CameraHeight:
    """The camera is carried so high over the ground, in the median."""

    metres: float


@dataclass(frozen=True)
class SensorScale:
    """A depth sensor says it."""


ScaleSource = KnownDistances | TagSize | CameraHeight | SensorScale


def scale_source(text: str) -> ScaleSource | None:
    """What a text says; none where it is empty. Raises InputError where it cannot be understood."""
    text = text.strip()
    if not text:
        return None
    if text == "sensor":
        return SensorScale()
    if found := _TAG.fullmatch(text):
        return TagSize(found[1], _length(text, found[2]))
    if found := _HEIGHT.fullmatch(text):
        return CameraHeight(_length(text, found[1]))
    parts = [_DISTANCE.fullmatch(part.strip()) for part in text.split(";") if part.strip()]
    if not parts or None in parts:
        raise InputError(f"--scale-from {text[:60]} is not understood; {HOW}.")
    return KnownDistances(tuple(_distance(text, found) for found in parts if found is not None))


def _distance(text: str, found: re.Match[str]) -> KnownDistance:
    u1, v1, u2, v2 = (float(found[k]) for k in range(2, 6))
    if (u1, v1) == (u2, v2):
        raise InputError(f"--scale-from {text[:60]} has one pixel twice; give two.")
    return KnownDistance(int(found[1]), (u1, v1), (u2, v2), _length(text, found[6]))


def _length(text: str, number: str) -> float:
    metres = float(number)
    if not 0 < metres < LONGEST:
        raise InputError(f"--scale-from {text[:60]} has a length of {metres:g} m; give a real one.")
    return metres
