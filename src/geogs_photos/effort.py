"""Number of features of a photograph that are matched if the time for poses is limited."""

import math

from geogs.evaluation.duration import duration
from geogs.threads import worker_count
from geogs_photos.photo_features import MAX_FEATURES

FEATURES = (MAX_FEATURES, 2896, 2048, 1448, 1024)
"""Limits on the features of a photograph: each halves the time of matching."""
POSES = 0.5
"""Fraction of the time for the poses; the rest is for the map."""
LEAST_MAP = 20.0
"""Seconds of the smallest map, with loading, mesh and files."""
_A_PHOTOGRAPH, _ALIKE = 0.12, 0.1
"""Seconds of one core to read a photograph and find its features, and to choose its pairs."""
_TO_VERIFY, _TO_MATCH = 0.025, 0.105
"""Seconds of one core for the preview of a pair, whatever the number of features, and to match all
its features; the latter grows with their square."""
_TO_START, _TO_PLACE = 0.06, 0.24
"""Seconds to find a photograph's pose, on any number of cores: constant, and with all features."""
_PAIRS = 20.0
"""Matched pairs for each photograph, if there are many photographs."""


def seconds_to_find_poses(count: int, features: int) -> float:
    """Approximate seconds to find the poses of ``count`` photographs."""
    part = features / MAX_FEATURES
    pairs = min(0.5 * count * (count - 1), _PAIRS * count)
    shared = (_A_PHOTOGRAPH + _ALIKE) * count + (_TO_VERIFY + _TO_MATCH * part**2) * pairs
    return shared / worker_count() + (_TO_START + _TO_PLACE * part) * count


def features_for(count: int, seconds: float | None) -> int:
    """The most features with which poses take their fraction of ``seconds``, else the fewest."""
    if seconds is None:
        return MAX_FEATURES
    fit = (n for n in FEATURES if seconds_to_find_poses(count, n) <= POSES * seconds)
    return next(fit, FEATURES[-1])


def what_does_not_fit(count: int, seconds: float | None) -> str:
    """Note or warning if the time is too short for ``count`` photographs or needs fewer features;
    empty if it is enough."""
    if seconds is None or (features := features_for(count, seconds)) == MAX_FEATURES:
        return ""
    least = seconds_to_find_poses(count, features)
    if least + LEAST_MAP <= seconds:
        return (
            f"note: For the --budget the poses are found from {features} features a photograph "
            f"instead of {MAX_FEATURES}, in about {duration(least)}."
        )
    whole = least + LEAST_MAP
    return (
        f"warning: The --budget will not do: the poses of {count} photographs take about "
        f"{duration(least)} here, and the smallest map {duration(LEAST_MAP)}, so that it takes "
        f"about {duration(whole)}. --budget {math.ceil(whole / 10) * 10}s would do, or "
        "--input.stride 2, which takes half of the photographs."
    )
