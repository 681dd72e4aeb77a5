"""Check that poses fit the images, or find the axis convention in which they do."""

import logging
from dataclasses import dataclass

import numpy as np

from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.geometry.epipolar import epipolar_distance, homogeneous, in_front_of_both
from geogs.io.sources.posed.conventions import Poses, conventions_for
from geogs.io.sources.posed.matching import MatchedPair, Matcher
from geogs.io.sources.posed.posed_source import PosedSource

PAIRS = 8
"""Number of image pairs used."""
GOOD_ERROR = 0.004
"""Largest median epipolar error of poses that fit, relative to the long edge."""
GOOD_IN_FRONT = 0.75
"""Least fraction of matches in front of both cameras if the poses fit."""
CLEARLY = 3.0
"""Least ratio of the error of wrong poses to that of the convention that fits."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Fit:
    """Agreement of poses with matches between images."""

    error: float
    """Median Sampson distance to the epipolar line, relative to the long edge."""
    in_front: float
    """Fraction of matches whose rays meet in front of both cameras."""

    @property
    def is_good(self) -> bool:
        """Whether the poses explain the matches."""
        return self.error <= GOOD_ERROR and self.in_front >= GOOD_IN_FRONT

    @property
    def badness(self) -> float:
        """Score to compare conventions: the error, increased where points lie behind."""
        return max(self.error, 1e-4) / max(self.in_front, 0.05) ** 2


@dataclass(frozen=True, slots=True)
class PoseCheck:
    """Outcome of the check."""

    given: Fit | None
    """Fit of the poses as they are; none where no images could be matched."""
    pairs: int
    """Number of matched image pairs."""
    warning: str | None
    """Warning for the user; none where the poses fit."""


def check_poses(source: PosedSource) -> PoseCheck:
    """Match features between neighbouring images and check whether the poses explain them.

    Neither the scale nor the frame of the world matters. Takes about two seconds.

    Raises:
        InputError: the poses clearly do not fit, but do in another axis convention.
    """
    matcher = Matcher(source)
    matched = matcher.pairs(PAIRS)
    if not matched:
        text = (
            f"{source.name}: no two neighbouring images have enough features in common, so the "
            f"poses could not be checked against the images."
        )
        return PoseCheck(None, 0, text)
    return judge(source, matched, matcher.camera)


def judge(source: PosedSource, pairs: list[MatchedPair], camera: Camera) -> PoseCheck:
    """Check whether the poses of ``source`` explain matches in pixels of ``camera``.

    Raises:
        InputError: as :func:`check_poses`.
    """
    given = fit_of(source.T_cw, pairs, camera)
    if given.is_good:
        _log.info("%s: the poses fit the images (%s).", source.name, _words(given, camera))
        return PoseCheck(given, len(pairs), None)
    best, convention = min(
        ((fit_of(c.correct(source.T_cw), pairs, camera), c) for c in conventions_for(source.kind)),
        key=lambda pair: pair[0].badness,
    )
    if best.is_good and given.badness > CLEARLY * best.badness:
        raise InputError(
            f"{source.name}: the poses do not fit the images ({_words(given, camera)}); they "
            f"look like {convention.name} ({_words(best, camera)}): {convention.remedy}."
        )
    text = (
        f"{source.name}: the poses explain the images badly ({_words(given, camera)}), and no "
        f"other axis convention does better; are poses, intrinsics and images of one set?"
    )
    return PoseCheck(given, len(pairs), text)


def fit_of(T_cw: Poses, pairs: list[MatchedPair], camera: Camera) -> Fit:
    """Agreement of poses with matched pairs: the median over pairs."""
    K_inverse = np.linalg.inv(camera.K)
    errors, in_front = [], []
    for pair in pairs:
        T = T_cw[pair.second] @ np.linalg.inv(T_cw[pair.first])
        one, two = (homogeneous(p) for p in (pair.pixels_first, pair.pixels_second))
        errors.append(np.median(epipolar_distance(T, K_inverse, one, two)))
        in_front.append(in_front_of_both(T, one @ K_inverse.T, two @ K_inverse.T).mean())
    return Fit(float(np.median(errors)) / camera.long_edge, float(np.median(in_front)))


def _words(fit: Fit, camera: Camera) -> str:
    pixels = fit.error * camera.long_edge
    return f"{pixels:.1f} pixels off, {100 * fit.in_front:.0f} % in front of the cameras"
