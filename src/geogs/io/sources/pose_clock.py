"""The clock of given poses against that of the images: its unit, and an offset by the motion."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float64

from geogs.camera.shutter.rates import FlowMeter, angular_velocity
from geogs.camera.shutter.rolling_camera import RollingCamera
from geogs.errors import InputError
from geogs.io.sources.reader import RawFrame
from geogs.types import Trajectory

UNITS = {1.0: "seconds", 1e-3: "milliseconds", 1e-6: "microseconds", 1e-9: "nanoseconds"}
"""Seconds a unit, and its name."""
STEPS = (1e-3, 1.0)
"""Shortest and longest median time between two poses, seconds."""
SAME_SPAN = 0.02
"""Relative difference up to which two spans of time count as equal."""
GRID = 0.02
"""Seconds between two samples of the turning rate."""
AGREEMENT = 0.8
"""Least correlation of the turning rates of poses and images."""
CLEARLY = 2.0
"""Least ratio of what lacks to a full correlation at any other offset to that at the best."""
LEAST_VARIATION = 0.02
"""Least standard deviation of a turning rate that can be recognised, radians per second."""
LONGEST_SEARCH = 86_400.0
"""Longest span of offsets that are tried, seconds: poses with some unset times span many years."""
LEAST_OVERLAP = 0.5
"""Least fraction of the video's time that poses must cover."""


@dataclass(frozen=True, slots=True)
class Turning:
    """Turning rate of a camera."""

    times: Float64[np.ndarray, "n"]
    """Seconds."""
    rates: Float64[np.ndarray, "n 3"]
    """Rotation of rays in the camera's axes, radians per second."""


def on_clock(
    poses: Trajectory, first: float, last: float, turning: Callable[[], Turning], name: str
) -> tuple[Trajectory, str]:
    """Poses by the clock of the images, and a sentence on the change; empty where there is none.

    Args:
        poses: as given.
        first: time of the first image, seconds.
        last: time of the last.
        turning: measures the turning rate of the camera in the images; called only if the clocks
            differ.
        name: of the poses, for messages.

    Raises:
        InputError: no pose is at the time of an image, and no unit or offset explains it.
    """
    times = poses.timestamps
    unit = _unit(times)
    seconds = times * unit
    is_shared = _overlaps(times, first, last)
    is_better = not is_shared or _shared(seconds, first, last) > _shared(times, first, last)
    if is_better and _overlaps(seconds, first, last):
        return _moved(poses, seconds), f"the times of {name} are {UNITS[unit]}"
    if is_shared:
        return poses, ""
    images = turning()
    given = _turning_of(poses, seconds)
    lasting = seconds[-1] - seconds[0]
    is_alike = abs(lasting - (last - first)) <= SAME_SPAN * (last - first)
    offset = float(seconds[0] - first) if is_alike else None
    evidence = "as both last equally long; the camera hardly turns"
    if _tells(images) and _tells(given):
        offset = _by_turning(given, images, offset)
        evidence = "by the turning of the camera"
    if offset is None:
        raise InputError(
            f"{name}: no pose is at the time of an image: its times are {times[0]:.2f} to "
            f"{times[-1]:.2f}, those of the images {first:.2f} to {last:.2f} s, and the turning of "
            "poses and images does not show by how much the clocks differ; give poses with the "
            "times of the images."
        )
    told = "" if unit == 1 else f" (in {UNITS[unit]})"
    sentence = f"the clock of {name}{told} is {offset:.3f} s ahead of that of the images"
    return _moved(poses, seconds - offset), f"{sentence}, {evidence}"


def turning_rates(images: Iterable[RawFrame], camera: RollingCamera) -> Turning:
    """Turning rate of the camera between neighbouring images, by their flow."""
    meter = FlowMeter(camera)

    def small() -> Iterator[tuple[float, np.ndarray]]:
        for raw in images:
            if raw.image is not None:
                yield raw.timestamp, meter.small(raw.image)

    found = []
    for (begin, one), (end, two) in pairwise(small()):
        rate = angular_velocity(meter.measure(one, two), end - begin, 0.0) if end > begin else None
        if rate is not None:
            found.append(((begin + end) / 2, rate))
    rates = np.array([rate for _, rate in found], dtype=np.float64).reshape(-1, 3)
    return Turning(np.array([time for time, _ in found]), rates)


def _overlaps(times: Float64[np.ndarray, "n"], first: float, last: float) -> bool:
    return bool(((times >= first - GRID) & (times <= last + GRID)).any())


def _shared(times: Float64[np.ndarray, "n"], first: float, last: float) -> float:
    """The time that poses and images both cover, relative to that which any of them covers."""
    both = min(times[-1], last) - max(times[0], first)
    return float(both / max(max(times[-1], last) - min(times[0], first), GRID))


def _unit(times: Float64[np.ndarray, "n"]) -> float:
    """Unit by which poses are apart as those of a camera are; seconds where none is."""
    step = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    return next((unit for unit in UNITS if STEPS[0] <= step * unit <= STEPS[1]), 1.0)


def _moved(poses: Trajectory, seconds: Float64[np.ndarray, "n"]) -> Trajectory:
    return Trajectory(seconds, poses.T_wc, poses.tracked)


def _turning_of(poses: Trajectory, seconds: Float64[np.ndarray, "n"]) -> Turning:
    """Turning rate between neighbouring poses, at these times."""
    from scipy.spatial.transform import Rotation  # a run without poses does not need it

    turned = Rotation.from_matrix(poses.T_wc[:, :3, :3])
    steps = np.diff(seconds)
    known = steps > 0
    rates = (turned[1:].inv() * turned[:-1]).as_rotvec()[known] / steps[known, None]
    return Turning((seconds[:-1] + seconds[1:])[known] / 2, rates)


def _tells(turning: Turning) -> bool:
    """Whether the turning rate varies enough to be recognised."""
    rates = turning.rates
    return len(rates) >= 10 and float(rates.std(axis=0).max()) > LEAST_VARIATION


def _by_turning(given: Turning, images: Turning, aligned: float | None) -> float | None:
    """The offset at which the turning rates correlate best, if they clearly do there alone.

    ``aligned`` is the offset at which both begin, where they last equally long: it is taken if it
    is about as good.
    """
    times = images.times
    span = times[-1] - times[0]
    spare = (1 - LEAST_OVERLAP) * span
    least, most = given.times[0] - times[0] - spare, given.times[-1] - times[-1] + spare
    if most - least > LONGEST_SEARCH:
        return None
    offsets = np.arange(least, most + GRID, GRID)
    scores = np.array([_correlation(given, images, offset) for offset in offsets])
    if not len(scores) or scores.max() < AGREEMENT:
        return None
    best = int(np.argmax(scores))
    missing = 1 - scores[best]
    if aligned is not None and 1 - _correlation(given, images, aligned) < 2 * missing:
        return aligned
    apart = np.abs(offsets - offsets[best]) > max(1.0, 0.1 * span)
    if 1 - scores[apart].max(initial=0.0) < CLEARLY * missing:
        return None
    return float(offsets[best] + GRID * _vertex(scores, best))


def _correlation(given: Turning, images: Turning, offset: float) -> float:
    """Correlation of the two rates where both are known; 0 where they overlap too little."""
    times = images.times + offset
    inside = (times >= given.times[0]) & (times <= given.times[-1])
    if inside.sum() < max(10, LEAST_OVERLAP * len(times)):
        return 0.0
    one = images.rates[inside]
    two = np.stack([np.interp(times[inside], given.times, axis) for axis in given.rates.T], axis=1)
    one = one - one.mean(axis=0)
    two = two - two.mean(axis=0)
    length = np.linalg.norm(one) * np.linalg.norm(two)
    return float((one * two).sum() / length) if length > 0 else 0.0


def _vertex(scores: Float64[np.ndarray, "n"], best: int) -> float:
    """Vertex of the parabola through the best score and its neighbours, in samples from it."""
    if not 0 < best < len(scores) - 1:
        return 0.0
    before, at, after = scores[best - 1 : best + 2]
    bend = before - 2 * at + after
    return float(0.5 * (before - after) / bend) if bend < 0 else 0.0
