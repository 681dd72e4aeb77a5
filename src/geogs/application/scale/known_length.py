"""Known lengths in metres, as given by ``--scale-from``, and the scale of a map by them."""

import re
from dataclasses import dataclass

from geogs.application.scale.distance import KnownDistance, KnownDistances, scale_by_distances
from geogs.application.scale.ground import CameraHeight, scale_by_height
from geogs.application.scale.measurable_scene import MeasurableScene
from geogs.application.scale.tags import TagSize, scale_by_tags
from geogs.errors import InputError
from geogs.io.sources.calibration import Calibration
from geogs.types import MetricScale

_NUMBER = r"([-+]?[0-9]*\.?[0-9]+(?:[eE][-+]?[0-9]+)?)"
_DISTANCE = re.compile(rf"(\d+):{_NUMBER},{_NUMBER},{_NUMBER},{_NUMBER}={_NUMBER}m?")
_TAG = re.compile(rf"aruco:(DICT_\w+):{_NUMBER}m?")
_HEIGHT = re.compile(rf"height:{_NUMBER}m?")
MAX_LENGTH = 1e6
"""Upper limit of a known length, metres."""
HOW = (
    "give FRAME:u1,v1,u2,v2=1.25m, several of them with semicolons, aruco:DICT_5X5_50:0.12, "
    "height:1.6 or sensor"
)
"""Hint in error messages."""


@dataclass(frozen=True)
class SensorScale:
    """The scale of a depth sensor."""


KnownLength = KnownDistances | TagSize | CameraHeight
"""Known lengths that a map can be scaled by."""


def find_scale(scene: MeasurableScene, known: KnownLength, calibration: Calibration) -> MetricScale:
    """Estimate metres per map unit; ``calibration`` is that of the stored images.

    Raises InputError where the scene does not determine it.
    """
    match known:
        case KnownDistances():
            return scale_by_distances(scene, known, calibration)
        case TagSize():
            return scale_by_tags(scene, known)
        case CameraHeight():
            return scale_by_height(scene, known)


def scale_source(text: str) -> KnownLength | SensorScale | None:
    """Parse ``--scale-from``; none where it is empty. Raises InputError for a wrong text."""
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
    if not 0 < metres < MAX_LENGTH:
        raise InputError(f"--scale-from {text[:60]} has a length of {metres:g} m; give a real one.")
    return metres
