"""How long a rolling shutter takes to read an image, told by the video itself.

Two views of a rigid scene obey an essential matrix, if all of a view is seen at once. Rows seen
at other times, brought to that of the middle row by the right readout, do so best. A camera that
turned alike in both views hides it: what tells is pairs whose angular velocities differ.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from geogs.shutter.camera import RollingCamera
from geogs.shutter.epipolar import refined_costs, relative_pose
from geogs.shutter.neighbours import Image
from geogs.shutter.rates import FlowMeter, RayFlow, angular_velocity
from geogs.shutter.turning import Step, Turning, rotated, turning_between

CANDIDATES = np.arange(0, 37.5, 3.0) / 1000
"""Seconds; also the order of size of a video's interval, which no readout exceeds."""
GAPS = 0.1, 0.6
"""Seconds between the two views of a pair."""
PAIRS = 32
"""That are compared, at most."""
SPAN, USES = 0.25, 4
"""Of views within so many seconds as many are used in pairs, at most, so that pairs spread."""
FRAMES = 300
"""That are worth giving; more only cost time."""
FEATURES, RATIO = 1000, 0.75
"""Of a view, at most; distance of a match to that of the second best."""
MATCHES = 60
"""Of a pair, at least."""
TOLERANCE = 0.5
"""Pixels of error at which a match counts for half."""

LEAST_PAIRS = 12
LEAST_SHARE = 0.65
"""Of the pairs, that are better with half of the readout than without."""
LEAST_EVIDENCE = 3.0
"""Standard errors of the mean by which they are better. Measured: below 1.5 for global shutters,
3.7 to 7 for parts of a hand-held Kinect's video."""
LEAST_GAIN = 0.005
"""Share of the cost of a pair that the readout saves, in the mean."""
LEAST_SHIFT = 0.25
"""Pixels by which the readout moves the first or last row of one view against the other's; what
moves them less is not worth a remapping."""

Report = Callable[[float], None]


@dataclass(frozen=True)
class FoundReadout:
    """What a video says of its readout."""

    readout: float = 0.0
    """Seconds; 0 where no other is believed."""
    best: float = 0.0
    """At which the pairs agree best, believed or not."""
    share: float = 0.0
    """Of the pairs that are better at half of the best than with a global shutter."""
    evidence: float = 0.0
    """Standard errors of the mean by which they are."""
    gain: float = 0.0
    """Share of the cost of a pair that the best saves, in the mean."""
    pairs: int = 0
    """Compared."""
    shift: float = 0.0
    """Pixels by which the best moves the first or last row of one view against the other's,
    median."""

    @property
    def is_believed(self) -> bool:
        """Whether the video says that its shutter rolls."""
        return self.readout != 0


def find_readout(
    images: Iterable[Image], camera: RollingCamera, report: Report = lambda fraction: None
) -> FoundReadout:
    """Find the readout that makes views of a video agree best; 0 unless it is clearly better.

    Args:
        images: neighbours in the video.
        camera: that took them.
        report: called with the fraction done; what it raises passes through.
    """
    views = _views(images, camera, lambda count: report(0.5 * min(1.0, count / FRAMES)))
    features = _Features(views)
    curves: list[Float[np.ndarray, "k"]] = []
    apart: list[float] = []
    for i, j in _pairs(views, 2 * LEAST_SHIFT / (float(CANDIDATES[-1]) * camera.camera.fy)):
        report(0.5 + 0.5 * len(curves) / PAIRS)
        matches = features.matches(i, j)
        curve = None if matches is None else _curve(camera, (views[i], views[j]), matches)
        if curve is not None:
            curves.append(curve)
            apart.append(float(np.linalg.norm(views[i].at_once.rate - views[j].at_once.rate)))
        if len(curves) == PAIRS:
            break
    report(1.0)
    return _verdict(
        np.array(curves).reshape(-1, len(CANDIDATES)), np.array(apart), camera.camera.fy
    )


@dataclass(frozen=True)
class View:
    """An image that may be one of a pair, and how the camera turned then."""

    timestamp: float
    """Seconds."""
    grey: UInt8[np.ndarray, "h w"]
    at_once: Turning
    """By a global shutter."""
    at_most: Turning
    """By the longest readout of the candidates."""

    def turning(self, readout: float) -> Turning:
        """By a readout: what a fit gives is very nearly linear in it."""
        share, one, other = readout / CANDIDATES[-1], self.at_once, self.at_most
        return Turning(
            one.rate + share * (other.rate - one.rate),
            one.acceleration + share * (other.acceleration - one.acceleration),
        )


def _views(images: Iterable[Image], camera: RollingCamera, report: Report) -> list[View]:
    """Those images of a video that have a neighbour on both sides which tells how they turned."""
    meter = FlowMeter(camera)
    greys, times, steps = [], [], []
    small: UInt8[np.ndarray, "h w"] | None = None
    for image in images:
        if image.image is None:
            continue
        last, small = small, meter.small(image.image)
        greys.append(cv2.cvtColor(image.image, cv2.COLOR_RGB2GRAY))
        times.append(image.timestamp)
        if last is not None:
            steps.append(_steps(meter.measure(last, small), times[-1] - times[-2]))
        report(len(greys))
    views = []
    for k in range(1, len(greys) - 1):
        before, after = steps[k - 1], steps[k]
        if before is not None and after is not None:
            turnings = (turning_between(*pair) for pair in zip(before, after, strict=True))
            views.append(View(times[k], greys[k], *turnings))
    return views


def _steps(flow: RayFlow, interval: float) -> tuple[Step, Step] | None:
    """The step between two images by a global shutter and by the longest readout."""
    rates = [angular_velocity(flow, interval, float(r)) for r in (CANDIDATES[0], CANDIDATES[-1])]
    if rates[0] is None or rates[1] is None:
        return None
    return Step(rates[0], interval), Step(rates[1], interval)


def _pairs(views: Sequence[View], least: float) -> list[tuple[int, int]]:
    """Pairs of views across a gap, those first whose angular velocities differ most.

    They differ by ``least`` radians per second; with less, no readout would show.
    """
    rates = np.array([view.at_once.rate for view in views]).reshape(-1, 3)
    times = np.array([view.timestamp for view in views])
    gap = times[None] - times[:, None]
    apart = np.linalg.norm(rates[None] - rates[:, None], axis=2)
    i, j = np.nonzero((gap >= GAPS[0]) & (gap <= GAPS[1]) & (apart >= least))
    order = np.argsort(-apart[i, j], kind="stable")
    used: Counter[int] = Counter()
    chosen = []
    for one, other in zip(i[order].tolist(), j[order].tolist(), strict=True):
        spans = [int(times[k] / SPAN) for k in (one, other)]
        if all(used[span] < USES for span in spans):
            chosen.append((one, other))
            used.update(spans)
    return chosen


class _Features:
    """Matches between views; what is found in a view is kept."""

    def __init__(self, views: Sequence[View]) -> None:
        self._views, self._detector = views, cv2.SIFT.create(FEATURES)
        self._kept: dict[int, tuple[np.ndarray, np.ndarray] | None] = {}

    def matches(self, i: int, j: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Pixels of the same points in both (m, 2); none where they are too few."""
        one, other = self._of(i), self._of(j)
        if one is None or other is None:
            return None
        nearest = cv2.BFMatcher().knnMatch(one[1], other[1], 2)
        sure = [m[0] for m in nearest if len(m) == 2 and m[0].distance < RATIO * m[1].distance]
        if len(sure) < MATCHES:
            return None
        return one[0][[m.queryIdx for m in sure]], other[0][[m.trainIdx for m in sure]]

    def _of(self, k: int) -> tuple[np.ndarray, np.ndarray] | None:
        if k not in self._kept:
            points, words = self._detector.detectAndCompute(self._views[k].grey, None)
            pixels = np.array([p.pt for p in points], dtype=np.float64).reshape(-1, 2)
            self._kept[k] = (pixels, words) if len(points) >= MATCHES else None
        return self._kept[k]


def _curve(
    camera: RollingCamera,
    views: tuple[View, View],
    matches: tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 2"]],
) -> Float[np.ndarray, "k"] | None:
    """The cost of the matches of two views by each candidate; none where no motion explains them.

    All candidates begin from the same motions, found by some of them.
    """
    moved = []
    for view, pixels in zip(views, matches, strict=True):
        rays, times = camera.rays(pixels), camera.line_times(pixels)
        angles = [view.turning(r).angles(r * times) for r in CANDIDATES]
        moved.append(np.stack([rotated(rays, -a) for a in angles]))
    first, second = moved
    tolerance = TOLERANCE / camera.camera.fx
    tried = range(0, len(CANDIDATES), 4)
    starts = [relative_pose(first[k], second[k], tolerance) for k in tried]
    costs = [refined_costs(s, first, second, tolerance) for s in starts if s is not None]
    return np.min(costs, axis=0) if costs else None


def _verdict(
    curves: Float[np.ndarray, "m k"], apart: Float[np.ndarray, "m"], focal: float
) -> FoundReadout:
    """What the costs of the pairs over the candidates say.

    Args:
        curves: costs, a row for each pair.
        apart: radians per second between the angular velocities of its views.
        focal: length in pixels.
    """
    if len(curves) < LEAST_PAIRS:
        return FoundReadout(pairs=len(curves))
    change = curves / curves[:, :1] - 1
    mean = change.mean(axis=0)
    best = _minimum(mean)
    # Errors of a pair blur its minimum, but better than nothing it is on this side of it.
    half = change[:, max(1, int(np.abs(CANDIDATES - best / 2).argmin()))]
    share = float((half < 0).mean())
    evidence = float(-half.mean() * math.sqrt(len(half)) / (half.std(ddof=1) + 1e-12))
    gain = float(-mean.min())
    shift = float(np.median(apart)) * best / 2 * focal
    believed = (
        share >= LEAST_SHARE
        and evidence >= LEAST_EVIDENCE
        and gain >= LEAST_GAIN
        and shift >= LEAST_SHIFT
    )
    readout = best if believed else 0.0
    return FoundReadout(readout, best, share, evidence, gain, len(curves), shift)


def _minimum(costs: Float[np.ndarray, "k"]) -> float:
    """Where a parabola through the least of the candidates' costs and its neighbours is least."""
    k = int(costs.argmin())
    around = slice(max(0, k - 2), k + 3)
    x, y = CANDIDATES[around], costs[around]
    curvature, slope, _ = np.polyfit(x - CANDIDATES[k], y, 2)
    if k == 0 or curvature <= 0:
        return float(CANDIDATES[k])
    least = float(CANDIDATES[k] - slope / (2 * curvature))
    return min(max(least, 0.0), float(CANDIDATES[-1]))
