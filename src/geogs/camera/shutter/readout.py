"""How long a rolling shutter takes to read an image, found in the video itself.

Points are followed through clips of neighbouring images, and each clip is adjusted as a whole:
poses, points, and one readout for all (``row_adjustment.py``). What tells it is that the velocity
of a camera changes from image to image, and with it by how much rows are sheared, while the scene
stays the same. Errors of the matches change slowly and are hardly taken for it.
"""

import functools
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from geogs.camera.shutter.clip_reconstruction import ClipReconstruction
from geogs.camera.shutter.clip_tracks import ClipTracks, FollowedClips
from geogs.camera.shutter.first_reconstruction import first_reconstruction
from geogs.camera.shutter.rolling_camera import RollingCamera
from geogs.camera.shutter.row_adjustment import NODES, ReadoutEquation, readout_equation
from geogs.geometry.least_squares import Policy, Step, minimise
from geogs.threads import thread_map

CLIP, SPAN = 30, 3.0
"""Neighbouring images that points are followed through, and seconds that these last, at most: where
images are far apart, the first and the last of so many would show other places."""
CLIPS = 12
"""Clips that are worth giving, from all over the video."""
ENOUGH_CLIPS, ENOUGH = (5, 7, 9), 0.002
"""No more clips are looked at where so many leave a standard error of so many seconds."""
CONFIDENT, SMALL = 3.0, 0.01
"""No more are looked at, either, where the readout is less than so many seconds by so many standard
errors."""
FIRST_TOLERANCE = 1.2
"""Pixels of an inlier between the two views that a clip begins with."""
EARLY_TOLERANCES, TOLERANCES = (4.0, 2.0, 1.2), ((1.2, 1), (0.6, 2), (0.3, 5))
"""Pixels of error at which a measurement counts for a quarter: in each step of fitting a clip
alone, as if its shutter were global; and in the stages of fitting all clips with the readout, with
the steps of each."""
SHORTER, ASSUMED = 0.78, 0.2
"""Ratio of a second focal length from which the adjustment begins to the assumed one, where the
relative deviation of that is larger than this; from a wrong one, rows and lens come to explain each
other."""
LARGEST_STEP = 0.015
"""Seconds."""
CONVERGED = 5e-5
"""Seconds of a step at the last tolerance after which there are no more."""
MISFIT, UNEXPLAINED = 3.0, 0.5
"""Multiple of the median cost beyond which a clip is left out, and cost beyond which it is in the
end: no readout explains it."""
COMMON = 0.03
"""Fraction of the error of the matches that they have in common, and that no number of them makes
less."""
TREMOR = 0.02
"""Fraction of the readout that is added for tremor between the images (jerks: 2 % too much)."""
FEWER, BETWEEN = 3, 4.0
"""Poses by which the readout is asked for once more, in one step, and what the square of the
fraction by which it changes then is worth of error. Of a wave, θ radians from image to image, three
poses miss θ²/6 of the velocity, five θ⁴/30: the one is seen, the other goes with its square. As
much more as waves of 2.2 Hz want at 4 to 10 images a second (docs/notebook/shutter.md)."""

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
    """The readout of a video, as far as the video tells it."""

    readout: float = 0.0
    """Seconds; 0 where no other is believed."""
    best: float = 0.0
    """Readout at which the clips fit best, believed or not."""
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
    """State of the adjustment: several clips, and the readout and lens that they share."""

    clips: list[_Adjusted]
    shared: Float[np.ndarray, "s"]
    """Seconds of the readout; then what is not known of the lens."""
    lens: tuple[float, ...]
    """Standard deviations of that before any clip is asked."""
    equations: list[ReadoutEquation] = field(default_factory=list)
    """One of each clip, where it was linearised last."""

    @property
    def fitting(self) -> list[ReadoutEquation]:
        """Equations of the clips that a rigid scene explains about as well as most."""
        if not self.equations:
            return []
        most = MISFIT * np.median([part.cost for part in self.equations])
        return [part for part in self.equations if part.cost <= most]

    @property
    def explained(self) -> float:
        """How much of what the clips measured fits, each clip being worth one at most."""
        return sum((1 - part.cost for part in self.equations), 0.0)


@dataclass(frozen=True)
class _CommonReadout:
    """The least-squares problem of clips and their readout."""

    tolerance: float
    """Fraction of the focal length."""
    around: int = NODES
    """Images whose poses say where a point is between them."""

    def linearise(self, state: _AdjustedClips) -> _AdjustedClips:
        """The clips that have not diverged, with their equations."""
        clips = [c for c in state.clips if c.reconstruction.is_finite]

        def equation(clip: _Adjusted) -> ReadoutEquation:
            return readout_equation(
                clip.tracks, clip.reconstruction, state.shared, self.tolerance, self.around
            )

        return replace(state, clips=clips, equations=thread_map(equation, clips))

    def step(
        self, state: _AdjustedClips, linear: _AdjustedClips, damping: float
    ) -> Step[_AdjustedClips] | None:
        """All clips after the step of the readout, which is limited."""
        parts, shared = linear.fitting, state.shared
        if not parts:
            return None
        known = _known_of_lens(state.lens)
        gradient = sum(p.gradient for p in parts) - known @ shared
        step = np.linalg.solve(_curvature(parts) + known, gradient)
        readout = float(np.clip(step[0], -LARGEST_STEP, LARGEST_STEP)) + shared[0]
        step[0] = float(np.clip(readout, -1.5 * LONGEST, 1.5 * LONGEST)) - shared[0]
        moved = [
            _Adjusted(c.tracks, part.stepped(c.reconstruction, step))
            for c, part in zip(linear.clips, linear.equations, strict=True)
        ]
        after = replace(linear, clips=moved, shared=shared + step)
        return Step(after, abs(float(step[0])))


def find_readout(
    clips: FollowedClips,
    camera: RollingCamera,
    report: Report = lambda fraction: None,
    lens: tuple[float, ...] = (),
) -> FoundReadout:
    """Find the readout with which clips of a video fit best; 0 unless it is clearly better.

    Args:
        clips: up to ``CLIP`` neighbours in the video each; no more are taken than are needed.
        camera: that took them.
        report: called with the fraction done; what it raises passes through.
        lens: standard deviations of a lens that is not known: of the relative focal length, k1 and
            k2, which are estimated, too. They would be taken for rows, and rows for them.
    """
    found = FoundReadout()
    begun = {1.0: list[_Adjusted]()}
    if lens and lens[0] > ASSUMED:
        begun[SHORTER] = []
    focal = camera.camera.fx
    with closing(clips.up_to((*ENOUGH_CLIPS, CLIPS), report)) as groups:
        for group in groups:
            tracks = [clip.through(camera) for clip in group]
            for factor, starts in begun.items():
                of_clip = functools.partial(_started, focal=focal, factor=factor)
                starts += [start for start in thread_map(of_clip, tracks) if start is not None]
            ends = {f: _adjusted(starts, focal, lens, f) for f, starts in begun.items()}
            best = max(ends, key=lambda factor: ends[factor].explained)
            begun, found = {best: begun[best]}, _verdict(ends[best], focal)
            if found.error <= ENOUGH or found.best + CONFIDENT * found.error < SMALL:
                break
    report(1.0)
    return found


def _started(tracks: ClipTracks, focal: float, factor: float) -> _Adjusted | None:
    """A clip whose poses are known roughly, by so many times the focal length."""
    scaled = replace(tracks, plane=tracks.plane / factor)
    start = first_reconstruction(scaled, FIRST_TOLERANCE / (factor * focal))
    if start is None:
        return None
    for tolerance in EARLY_TOLERANCES:
        if not start.is_finite:
            return None
        equation = functools.partial(
            readout_equation, scaled, shared=np.zeros(1), tolerance=tolerance / (factor * focal)
        )
        start = minimise(start, equation, _global_shutter_step, Policy(1)).state
    return _Adjusted(tracks, start)


def _global_shutter_step(
    at: ClipReconstruction, equation: ReadoutEquation, damping: float
) -> Step[ClipReconstruction]:
    return Step(equation.stepped(at, np.zeros(1)))


def _adjusted(
    starts: list[_Adjusted], focal: float, lens: tuple[float, ...], factor: float = 1.0
) -> _AdjustedClips:
    """All clips with the readout that fits them best, begun by so many times the focal length."""
    shared = np.zeros(1 + len(lens))
    shared[1:2] = factor - 1
    state = _AdjustedClips(starts, shared, lens)
    for tolerance, steps in TOLERANCES:
        is_last = tolerance == TOLERANCES[-1][0]
        policy = Policy(steps, tolerance=CONVERGED if is_last else 0.0)
        common = _CommonReadout(tolerance / focal)
        state = minimise(state, common.linearise, common.step, policy).state
    return state


def _verdict(state: _AdjustedClips, focal: float) -> FoundReadout:
    """The readout by which clips fit best, and whether it is believed."""
    readout, lens = float(state.shared[0]), state.lens
    parts = [part for part in state.fitting if part.cost <= UNEXPLAINED]
    fewer = _CommonReadout(TOLERANCES[-1][0] / focal, FEWER)
    by_fewer = fewer.step(state, fewer.linearise(state), 0.0)
    if len(parts) < LEAST_CLIPS or by_fewer is None:
        return FoundReadout(clips=len(parts))
    error = float(np.hypot(_standard_error(parts, lens), TREMOR * readout))
    if error == 0:  # Images that are alike to the bit: nothing moves.
        return FoundReadout()
    error = float(np.hypot(error, BETWEEN * by_fewer.size**2 / max(abs(readout), error)))
    confident = error <= LARGEST_ERROR and readout >= LEAST_EVIDENCE * error
    believed = confident and SHORTEST <= readout <= LONGEST
    return FoundReadout(readout if believed else 0.0, readout, error, len(parts))


def _curvature(parts: Sequence[ReadoutEquation]) -> Float[np.ndarray, "s s"]:
    """Curvature of several clips together."""
    total: Float[np.ndarray, "s s"] = np.sum([part.curvature for part in parts], 0)
    return total + 1e-12 * np.eye(len(total))


def _known_of_lens(lens: tuple[float, ...]) -> Float[np.ndarray, "s s"]:
    """Information on the lens before any clip is asked."""
    return np.diag([0.0, *(1 / np.square(lens))])


def _standard_error(parts: Sequence[ReadoutEquation], lens: tuple[float, ...]) -> float:
    """Seconds of the readout by what clips disagree, what their matches have in common, and what
    the lens may be beside what they say of it."""
    known = _known_of_lens(lens)
    of_readout = np.linalg.inv(_curvature(parts) + known)[0]
    moves = np.array([part.gradient @ of_readout for part in parts])
    count = len(parts)
    spread = np.sqrt((moves**2).sum() * count / (count - 1))
    # A readout's effect on a match against the error of one, root mean squares.
    common = COMMON * np.sqrt(sum(part.square for part in parts) * of_readout[0])
    return float(np.sqrt(spread**2 + common**2 + of_readout @ known @ of_readout))
