"""How long a rolling shutter takes to read an image, found in the video itself.

Points are followed through clips of neighbouring images, and each clip is adjusted as a whole:
poses, points, and one readout for all (``row_adjustment.py``). What tells it is that the velocity
of a camera changes from image to image, and with it by how much rows are sheared, while the scene
stays the same. Errors of the matches change slowly and are hardly taken for it.
"""

import functools
import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from geogs.geometry.least_squares import Policy, Step, minimise
from geogs.shutter.clip_reconstruction import ClipReconstruction
from geogs.shutter.clip_tracks import LEAST_IMAGES, ClipTracks, clip_tracks
from geogs.shutter.first_reconstruction import first_reconstruction
from geogs.shutter.neighbours import Image
from geogs.shutter.rolling_camera import RollingCamera
from geogs.shutter.row_adjustment import NODES, ReadoutEquation, readout_equation
from geogs.threads import thread_map

CLIP, SPAN = 30, 3.0
"""Neighbouring images that points are followed through, and seconds that these last, at most: where
images are far apart, the first and the last of so many would show other places."""
CLIPS = 12
"""That are worth giving, from all over the video."""
ENOUGH_CLIPS, ENOUGH = (5, 7, 9), 0.002
"""No more clips are looked at where so many leave a standard error of so many seconds."""
CONFIDENT, SMALL = 3.0, 0.01
"""Nor where the readout is less than so many seconds by so many standard errors."""
LONGEST_INTERVAL = 0.26
"""Seconds between two images; over more, nothing says how points move from one to the next."""
FIRST_TOLERANCE = 1.2
"""Pixels of an inlier between the two views that a clip begins with."""
EARLY_TOLERANCES, TOLERANCES = (4.0, 2.0, 1.2), ((1.2, 1), (0.6, 2), (0.3, 5))
"""Pixels of error at which a measurement counts for a quarter: of each step of the fit of a clip
alone, as if its shutter were global, and of the stages of the fit of all together with the readout,
with the number of their steps."""
LENS = 0.1, 0.2
"""Deviations of the k1 and k2 of a lens of which nothing is known."""
LARGEST_STEP = 0.015
"""Seconds."""
CONVERGED = 5e-5
"""Seconds of a step at the last tolerance after which there are no more."""
MISFIT = 1.5
"""A clip whose error is so many times the median's is left out."""
COMMON = 0.03
"""Fraction of the error of the matches that they have in common, and that no number of them makes
less."""
TREMOR = 0.02
"""Fraction of the readout that is added for tremor between the images (jerks: 2 % too much)."""
FEWER, BETWEEN = 3, 4.0
"""Poses by which the readout is asked for once more, in one step, and what the square of the
fraction by which it changes then is worth of error. Of a wave, θ radians from image to image, three
poses miss θ²/6 of the velocity, five θ⁴/30: the one is seen, the other goes with its square. As
much more as waves of 2.2 Hz want at 4 to 10 images a second (docs/shutter.md)."""

LONGEST, SHORTEST = 0.036, 0.002
"""Seconds of a readout that is believed; less is nothing to care about."""
LEAST_CLIPS = 3
LEAST_EVIDENCE = 4.0
"""Standard errors by which the readout differs from a global shutter's."""
LARGEST_ERROR = 0.006
"""Seconds of standard error with which a readout is believed."""

Report = Callable[[float], None]


@dataclass(frozen=True)
class FoundReadout:
    """What a video says of its readout."""

    readout: float = 0.0
    """Seconds; 0 where no other is believed."""
    best: float = 0.0
    """At which the clips fit best, believed or not."""
    error: float = float("inf")
    """Standard error of the best, seconds."""
    clips: int = 0
    """Parts of the video that say something."""

    @property
    def is_believed(self) -> bool:
        """Whether the video says that its shutter rolls."""
        return self.readout != 0

    @property
    def left_open(self) -> float:
        """Root mean square of what the readout may differ by from the one that counts, seconds.

        Where it counts as 0, by Bayes' rule: before the video was asked, every second shutter
        rolls, as likely in any time from ``SHORTEST`` to ``LONGEST`` as in another. Where the video
        says nothing, that is 15 ms.
        """
        if self.is_believed:
            return self.error
        rolling = np.linspace(SHORTEST, LONGEST, 500)
        readouts = np.append(np.zeros_like(rolling), rolling)
        fit = -0.5 * np.square((readouts - self.best) / self.error)
        likely = np.exp(fit - fit.max())
        return float(np.sqrt(likely @ readouts**2 / likely.sum()))


@dataclass(frozen=True)
class _Adjusted:
    """A clip and what is known of it so far."""

    tracks: ClipTracks
    reconstruction: ClipReconstruction


@dataclass(frozen=True)
class _AdjustedClips:
    """What is adjusted: several clips, and the readout and lens that they have in common."""

    clips: list[_Adjusted]
    shared: Float[np.ndarray, "s"]
    """Seconds of the readout; then k1 and k2, where they are not known."""
    equations: list[ReadoutEquation] = field(default_factory=list)
    """One of each of these clips, where it was linearised last."""

    @property
    def finite(self) -> list[_Adjusted]:
        """The clips that have not diverged."""
        return [c for c in self.clips if c.reconstruction.is_finite]


@dataclass(frozen=True)
class _CommonReadout:
    """The least-squares problem of clips and their readout."""

    tolerance: float
    """Fraction of the focal length."""
    around: int = NODES
    """Images whose poses say where a point is between them."""

    def linearise(self, state: _AdjustedClips) -> _AdjustedClips:
        """The clips that one readout may explain, with their equations; none if too few."""
        clips = state.finite
        if len(clips) < LEAST_CLIPS:
            return _AdjustedClips([], state.shared)
        equations = thread_map(functools.partial(self._equation, state.shared), clips)
        clips, equations = _fitting(clips, equations)
        return _AdjustedClips(clips, state.shared, equations)

    def _equation(self, shared: Float[np.ndarray, "s"], clip: _Adjusted) -> ReadoutEquation:
        return readout_equation(
            clip.tracks, clip.reconstruction, shared, self.tolerance, self.around
        )

    def step(
        self, state: _AdjustedClips, linear: _AdjustedClips, damping: float
    ) -> Step[_AdjustedClips] | None:
        """All clips after the step of the readout, which is limited."""
        if not linear.clips:
            return None
        parts, shared = linear.equations, state.shared
        known = _known_of_lens(shared)
        gradient = sum(p.gradient for p in parts) - known @ shared
        step = np.linalg.solve(_curvature(parts) + known, gradient)
        readout = float(np.clip(step[0], -LARGEST_STEP, LARGEST_STEP)) + shared[0]
        step[0] = float(np.clip(readout, -1.5 * LONGEST, 1.5 * LONGEST)) - shared[0]
        moved = [
            _Adjusted(c.tracks, part.stepped(c.reconstruction, step))
            for c, part in zip(linear.clips, parts, strict=True)
        ]
        return Step(_AdjustedClips(moved, shared + step, parts), abs(float(step[0])))


def find_readout(
    clips: Iterable[Sequence[Image]],
    camera: RollingCamera,
    report: Report = lambda fraction: None,
    lens_is_known: bool = True,
) -> FoundReadout:
    """Find the readout with which clips of a video fit best; 0 unless it is clearly better.

    Args:
        clips: up to ``CLIP`` neighbours in the video each; no more are taken than are needed, and
            the points of several are followed at a time.
        camera: that took them.
        report: called with the fraction done; what it raises passes through.
        lens_is_known: else its k1 and k2 are estimated, too; they would be taken for rows.
    """
    adjusted, found = list[_Adjusted](), FoundReadout()
    focal, left, seen = camera.camera.fx, iter(clips), 0
    for enough in (*ENOUGH_CLIPS, CLIPS):
        group = list(itertools.islice(left, enough - seen))
        done = functools.partial(_reported, report, seen, len(group))
        starts = thread_map(functools.partial(_started, camera=camera), group, done)
        adjusted += [start for start in starts if start is not None]
        seen += len(group)
        if seen < enough:
            break
        if enough in ENOUGH_CLIPS:
            found = _verdict(adjusted, focal, lens_is_known)
            if found.error <= ENOUGH or found.best + CONFIDENT * found.error < SMALL:
                break
    report(1.0)
    return found if found.clips == len(adjusted) else _verdict(adjusted, focal, lens_is_known)


def _reported(report: Report, before: int, group: int, fraction: float) -> None:
    """Tell what is done when so much is of some clips, before which there were others."""
    report(min(1.0, (before + fraction * group) / CLIPS))


def _started(clip: Sequence[Image], camera: RollingCamera) -> _Adjusted | None:
    """A clip whose points are followed and whose poses are known roughly."""
    intervals = np.diff([image.timestamp for image in clip])
    if len(clip) < LEAST_IMAGES or (intervals <= 0).any() or (intervals > LONGEST_INTERVAL).any():
        return None
    tracks = clip_tracks(clip, camera)
    if tracks is None:
        return None
    focal = camera.camera.fx
    start = first_reconstruction(tracks, FIRST_TOLERANCE / focal)
    if start is None:
        return None
    for tolerance in EARLY_TOLERANCES:
        if not start.is_finite:
            return None
        equation = functools.partial(
            readout_equation, tracks, shared=np.zeros(1), tolerance=tolerance / focal
        )
        start = minimise(start, equation, _global_shutter_step, Policy(1)).state
    return _Adjusted(tracks, start)


def _global_shutter_step(
    at: ClipReconstruction, equation: ReadoutEquation, damping: float
) -> Step[ClipReconstruction]:
    return Step(equation.stepped(at, np.zeros(1)))


def _verdict(clips: list[_Adjusted], focal: float, lens_is_known: bool = True) -> FoundReadout:
    """The readout that fits all clips best, and whether it is believed."""
    state = _AdjustedClips(clips, np.zeros(1 if lens_is_known else 1 + len(LENS)))
    for tolerance, steps in TOLERANCES:
        is_last = tolerance == TOLERANCES[-1][0]
        policy = Policy(steps, tolerance=CONVERGED if is_last else 0.0)
        common = _CommonReadout(tolerance / focal)
        solution = minimise(state, common.linearise, common.step, policy)
        state = solution.state
        if not solution.finite:
            return FoundReadout(clips=len(state.finite))
    readout, parts = float(state.shared[0]), state.equations
    fewer = _CommonReadout(TOLERANCES[-1][0] / focal, FEWER)
    by_fewer = fewer.step(state, fewer.linearise(state), 0.0)
    if len(parts) < LEAST_CLIPS or by_fewer is None:
        return FoundReadout(clips=len(parts))
    error = float(np.hypot(_standard_error(parts, state.shared), TREMOR * readout))
    error = float(np.hypot(error, BETWEEN * by_fewer.size**2 / max(abs(readout), error)))
    confident = error <= LARGEST_ERROR and readout >= LEAST_EVIDENCE * error
    believed = confident and SHORTEST <= readout <= LONGEST
    return FoundReadout(readout if believed else 0.0, readout, error, len(state.clips))


def _fitting(
    clips: list[_Adjusted], parts: list[ReadoutEquation]
) -> tuple[list[_Adjusted], list[ReadoutEquation]]:
    """Those clips that a rigid scene explains about as well as it explains most."""
    errors = np.array([np.sqrt(part.square / max(part.weight, 1e-12)) for part in parts])
    keep = np.flatnonzero(errors <= MISFIT * np.median(errors)).tolist()
    return [clips[k] for k in keep], [parts[k] for k in keep]


def _curvature(parts: Sequence[ReadoutEquation]) -> Float[np.ndarray, "s s"]:
    """Of several clips together."""
    total: Float[np.ndarray, "s s"] = np.sum([part.curvature for part in parts], 0)
    return total + 1e-12 * np.eye(len(total))


def _known_of_lens(shared: Float[np.ndarray, "s"]) -> Float[np.ndarray, "s s"]:
    """Information on its k1 and k2 before any clip is asked."""
    return np.diag([0.0, *(1 / np.square(LENS[: len(shared) - 1]))])


def _standard_error(parts: Sequence[ReadoutEquation], shared: Float[np.ndarray, "s"]) -> float:
    """Seconds of the readout by what clips disagree, and what their matches have in common."""
    of_readout = np.linalg.inv(_curvature(parts) + _known_of_lens(shared))[0]
    moves = np.array([part.gradient @ of_readout for part in parts])
    count = len(parts)
    spread = np.sqrt((moves**2).sum() * count / (count - 1))
    # A readout's effect on a match against the error of one, root mean squares.
    common = COMMON * np.sqrt(sum(part.square for part in parts) * of_readout[0])
    return float(np.hypot(spread, common))
