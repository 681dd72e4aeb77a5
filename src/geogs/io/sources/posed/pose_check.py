"""Check that poses and camera fit the images, or find the mistake without which they do."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.io.sources.account import named
from geogs.io.sources.posed.camera_fit import Lens, Matches, fitted, searched, stacked
from geogs.io.sources.posed.conventions import Poses, conventions_for
from geogs.io.sources.posed.matching import MatchedPair, Matcher
from geogs.io.sources.posed.posed_source import PosedSource

PAIRS = 32
"""Number of image pairs used, spread over all images."""
GOOD_ERROR = 0.004
"""Largest median epipolar error of poses that fit, relative to the long edge."""
GOOD_IN_FRONT = 0.75
"""Least fraction of matches in front of both cameras if the poses fit."""
CLEARLY = 3.0
"""Least ratio of the error of wrong poses to that of the convention that fits."""
BETTER = 1.5
"""Least ratio of the error with the given camera to that with another which is the right one."""
NOTICED = 0.0006
"""Error that counts, relative to the long edge: matches are no better than that."""
CHANGED = 0.05
"""Least relative change of focal length or aspect that is called wrong."""
IMPLAUSIBLE = np.log([6.0, 2.5])
"""Changes of log focal and log aspect that no mistake explains."""
SIGNIFICANT = 6.0
"""Least change of a camera's number in standard deviations."""
MAX_DEVIATION = 0.03
"""Largest relative standard deviation of a focal length that is used."""
FEWEST_PAIRS = 4
"""Fewest pairs that tell a camera."""
ODD_POSE = 8.0
"""Ratio of a pair's error to the median one above which a pose of it is wrong."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Fit:
    """Agreement of poses and camera with matches between images."""

    error: float
    """Median Sampson distance to the epipolar line, relative to the long edge."""
    in_front: float
    """Fraction of matches whose rays meet in front of both cameras."""
    rim: float
    """Median distance of matches in the outer part of the images, relative to the long edge."""

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
    """Fit of poses and camera as they are; none where no images could be matched."""
    pairs: int
    """Number of matched image pairs."""
    warning: str | None
    """Warning for the user; none where they fit."""

    @property
    def numbers(self) -> dict[str, int | float]:
        """Pairs, the median errors of all and at the rim relative to the longer side, and the
        fraction of matches in front of the cameras, for ``summary.json``."""
        if self.given is None:
            return {"pairs": 0}
        fit = self.given
        return {
            "pairs": self.pairs,
            "error": round(fit.error, 6),
            "rim_error": round(fit.rim, 6),
            "in_front": round(fit.in_front, 3),
        }


def check_poses(source: PosedSource) -> PoseCheck:
    """Match features between neighbouring images and check whether poses and camera explain them.

    Neither the scale nor the frame of the world matters. Takes a few seconds.

    Raises:
        InputError: they clearly do not fit, but do with another axis convention or camera.
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


def judge(source: PosedSource, pairs: Sequence[MatchedPair], camera: Camera) -> PoseCheck:
    """Check whether poses and camera of ``source`` explain matches in pixels of ``camera``.

    Raises:
        InputError: as :func:`check_poses`.
    """
    matches = stacked(pairs, camera)
    lens = Lens(camera.fx, camera.fy / camera.fx)
    given = fit_of(source.T_cw, matches, lens, camera)
    if not given.is_good or given.error > NOTICED:
        _check_conventions(source, matches, lens, camera, given)
    _check_camera(source, matches, lens, camera, given)
    text = None
    if not given.is_good:
        text = (
            f"{source.name}: the poses explain the images badly ({_words(given, camera)}), and "
            "neither another axis convention nor another camera does better; are poses, "
            "intrinsics and images of one set?"
        )
    else:
        _log.info("%s: the poses fit the images (%s).", source.name, _words(given, camera))
        if odd := _odd_images(source, matches, lens):
            text = f"{source.name}: the poses of {named(odd)} do not fit the others"
    return PoseCheck(given, len(pairs), text)


def with_focal_length(source: PosedSource) -> PosedSource:
    """The source with the focal length that its images and poses tell, where none is known.

    Raises:
        InputError: they do not tell it.
    """
    if not source.is_focal_guess:
        return source
    matcher = Matcher(source)
    pairs = matcher.pairs(PAIRS)
    camera = matcher.camera
    if len(pairs) >= FEWEST_PAIRS:
        matches = stacked(pairs, camera)
        found = searched(matches, matches.relative(source.T_cw), camera.fy / camera.fx)
        fit = fit_of(source.T_cw, matches, found.lens, camera)
        if found.deviations[0] <= MAX_DEVIATION and fit.is_good:
            return source.with_focal(found.lens.focal / camera.fx, float(found.deviations[0]))
    raise InputError(
        f"{source.name}: the focal length is not given, and matches between the images do not "
        "tell it; give --intrinsics fx,fy,cx,cy."
    )


def fit_of(T_cw: Poses, matches: Matches, lens: Lens, camera: Camera) -> Fit:
    """Agreement of poses and a lens with matches: the medians over pairs."""
    T = matches.relative(T_cw)
    errors = np.abs(matches.errors(T, lens))
    is_in_front = matches.in_front(T, lens)
    by_pair = [matches.pair == k for k in range(len(T))]
    error = np.median([np.median(errors[here]) for here in by_pair])
    in_front = np.median([is_in_front[here].mean() for here in by_pair])
    rim = matches.is_rim
    outer = np.median(errors[rim]) if rim.any() else error
    edge = camera.long_edge
    return Fit(float(error) / edge, float(in_front), float(outer) / edge)


def _check_conventions(
    source: PosedSource, matches: Matches, lens: Lens, camera: Camera, given: Fit
) -> None:
    """Raise InputError where the poses fit by another axis convention."""
    conventions = conventions_for(source.kind)
    fits = [fit_of(c.correct(source.T_cw), matches, lens, camera) for c in conventions]
    best, convention = min(zip(fits, conventions, strict=True), key=lambda pair: pair[0].badness)
    if best.is_good and given.badness > CLEARLY * best.badness:
        raise InputError(
            f"{source.name}: the poses do not fit the images ({_words(given, camera)}); they "
            f"look like {convention.name} ({_words(best, camera)}): {convention.remedy}."
        )


def _check_camera(
    source: PosedSource, matches: Matches, lens: Lens, camera: Camera, given: Fit
) -> None:
    """Raise InputError where the images fit by another focal length, aspect or distortion.

    Errors count at the rim, where a wrong camera shows most. The simplest camera that is about as
    good as the best is named.
    """
    worst = max(given.error, given.rim)
    if len(matches.images) < FEWEST_PAIRS or worst < NOTICED or given.in_front < GOOD_IN_FRONT:
        return
    T = matches.relative(source.T_cw)
    start = searched(matches, T, lens.aspect).lens
    tried = [fitted(matches, T, start, free) for free in ((0,), (0, 1), (0, 2, 3))]
    fits = [fit_of(source.T_cw, matches, found.lens, camera) for found in tried]
    errors = [max(fit.error, fit.rim, NOTICED / 2) for fit in fits]
    chosen = next(k for k, error in enumerate(errors) if error < 1.3 * min(errors))
    if worst < BETTER * errors[chosen] or not fits[chosen].is_good:
        return
    found = tried[chosen]
    change = np.log([found.lens.focal / lens.focal, found.lens.aspect / lens.aspect])
    is_changed = np.abs(change) > np.maximum(CHANGED, SIGNIFICANT * found.deviations[:2])
    is_changed &= (np.abs(change) < IMPLAUSIBLE) & (found.deviations[:2] < CHANGED)
    scale = source.camera.fx / lens.focal
    fault = None
    if chosen == 2 and worst > 2 * errors[2]:
        fault = (
            f"matches are {_pixels(given.error, camera)} off in the middle and "
            f"{_pixels(given.rim, camera)} at the rim, as where a lens's distortion is missing or "
            "of another model (fisheye?)"
        )
    elif chosen == 1 and is_changed[1]:
        aspects = f"{found.lens.aspect:.3f}, not {lens.aspect:.3f}"
        fault = f"these fit fy / fx = {aspects}, as where images were squeezed"
    elif chosen < 2 and is_changed[0]:
        size = f"{source.camera.width} x {source.camera.height}"
        focals = f"{found.lens.focal * scale:.0f} pixels, not {source.camera.fx:.0f}"
        fault = f"these fit a focal length of {focals} (working images of {size})"
    if fault:
        raise InputError(
            f"{source.name}: the intrinsics ({source.intrinsics_origin}) do not fit images and "
            f"poses: {fault}; give the right --intrinsics."
        )


def _odd_images(source: PosedSource, matches: Matches, lens: Lens) -> list[str]:
    """Images all of whose pairs fit far worse than most."""
    errors = np.abs(matches.errors(matches.relative(source.T_cw), lens))
    by_pair = np.array([np.median(errors[matches.pair == k]) for k in range(len(matches.images))])
    limit = max(ODD_POSE * float(np.median(by_pair)), GOOD_ERROR * 2 * matches.reach)
    bad = set(matches.images[by_pair > limit].ravel().tolist())
    good = set(matches.images[by_pair <= limit].ravel().tolist())
    return [source.label(k).rsplit("/", 1)[-1] for k in sorted(bad - good)]


def _pixels(error: float, camera: Camera) -> str:
    return f"{error * camera.long_edge:.1f} pixels"


def _words(fit: Fit, camera: Camera) -> str:
    return f"{_pixels(fit.error, camera)} off, {100 * fit.in_front:.0f} % in front of the cameras"
