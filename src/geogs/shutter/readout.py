"""How long a rolling shutter takes to read an image, told by the video itself.

Two views of a rigid scene obey an essential matrix, if all of a view is seen at once. Points that
are followed through the images around a view tell where each was at the time of the middle row, for
any readout; the readout is fitted together with the motions of all pairs of views. A camera whose
motion does not change, or a slow one, leaves too little of it: what the motions of the pairs can
explain as well tells nothing, and the errors that matches have in common weigh more.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from geogs.shutter.camera import RollingCamera
from geogs.shutter.epipolar import RelativePose, relative_pose
from geogs.shutter.moments import AROUND, Passage
from geogs.shutter.neighbours import Image
from geogs.shutter.tracks import followed_points

CLIP = 20
"""Neighbouring images that points are followed through."""
CLIPS = 16
"""That are worth giving, from all over the video."""
ENOUGH_CLIPS, ENOUGH = (6, 9, 12), 0.002
"""No more clips are looked at where so many leave a standard error of so many seconds."""
VIEWS = (2, 17), (2, 10), (9, 17), (5, 14)
"""Pairs of images of a clip."""
LONGEST_INTERVAL = 0.12
"""Seconds between two images; over more, nothing says how points move from one to the next."""
MATCHES = 40
"""Of a pair, at least."""
TOLERANCES = 1.2, 1.2, 0.6, 0.6, 0.3, 0.3, 0.3, 0.3
"""Pixels of error at which a match counts for a quarter, of each step of the fit."""
LARGEST_STEP = 0.015
"""Seconds."""
COMMON = 0.1
"""Share of the error of the matches that they have in common, and that no number of them makes
less. Measured: what steady motions seem to say of a readout is off by up to 0.18 of it."""

LONGEST, SHORTEST = 0.036, 0.002
"""Seconds of a readout that is believed; less is nothing to care about."""
LEAST_CLIPS = 3
LEAST_PAIRS = 12
"""Of views; of more, the half that tells more is used."""
LEAST_EVIDENCE = 4.0
"""Standard errors by which the readout differs from a global shutter's."""
LARGEST_ERROR = 0.004
"""Seconds of standard error with which a readout is believed."""

Report = Callable[[float], None]


@dataclass(frozen=True)
class FoundReadout:
    """What a video says of its readout."""

    readout: float = 0.0
    """Seconds; 0 where no other is believed."""
    best: float = 0.0
    """At which the pairs agree best, believed or not."""
    error: float = float("inf")
    """Standard error of the best, seconds."""
    clips: int = 0
    """Parts of the video that say something."""
    pairs: int = 0
    """Of views, in these."""

    @property
    def is_believed(self) -> bool:
        """Whether the video says that its shutter rolls."""
        return self.readout != 0


def find_readout(
    clips: Iterable[Sequence[Image]],
    camera: RollingCamera,
    report: Report = lambda fraction: None,
) -> FoundReadout:
    """Find the readout that makes views of a video agree best; 0 unless it is clearly better.

    Args:
        clips: ``CLIP`` neighbours in the video each; no more are taken than are needed.
        camera: that took them.
        report: called with the fraction done; what it raises passes through.
    """
    posed: list[_Posed] = []
    for number, clip in enumerate(clips, 1):
        report(min(1.0, (number - 1) / CLIPS))
        posed += _pairs(clip, camera, number)
        if number in ENOUGH_CLIPS and _verdict(posed, camera.camera.fx).error <= ENOUGH:
            break
    report(1.0)
    return _verdict(posed, camera.camera.fx)


@dataclass(frozen=True)
class _Pair:
    """The same points in two views of a clip."""

    clip: int
    first: Passage
    second: Passage

    def at_once(self, readout: float) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
        """The points in both views, each view seen at once."""
        return self.first.at_once(readout), self.second.at_once(readout)


@dataclass(frozen=True)
class _Posed:
    """A pair and the motion between its views."""

    pair: _Pair
    pose: RelativePose


def _pairs(clip: Sequence[Image], camera: RollingCamera, number: int) -> list[_Posed]:
    """The pairs of a clip that have enough points, with a motion that explains most of them."""
    times = np.array([image.timestamp for image in clip])
    intervals = np.diff(times)
    if len(clip) < CLIP or (intervals <= 0).any() or (intervals > LONGEST_INTERVAL).any():
        return []
    images = [image.image for image in clip if image.image is not None]
    if len(images) < CLIP:
        return []
    pixels = followed_points([cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in images])
    seen = np.isfinite(pixels[..., 0])
    plane, line_times = np.zeros_like(pixels), np.zeros(seen.shape)
    rays = camera.rays(pixels[seen])
    plane[seen], line_times[seen] = rays[:, :2] / rays[:, 2:], camera.line_times(pixels[seen])
    pairs = []
    for views in VIEWS:
        around = [slice(k - AROUND, k + AROUND + 1) for k in views]
        both = np.logical_and(*(seen[near].all(axis=0) for near in around))
        if both.sum() >= MATCHES:
            passages = [
                Passage(plane[near][:, both], line_times[near][:, both], times[near] - times[k])
                for k, near in zip(views, around, strict=True)
            ]
            pair = _Pair(number, *passages)
            pose = relative_pose(*pair.at_once(0.0), TOLERANCES[0] / camera.camera.fx)
            if pose is not None:
                pairs.append(_Posed(pair, pose))
    return pairs


def _verdict(posed: list[_Posed], focal: float) -> FoundReadout:
    """The readout that fits all pairs best, and whether it is believed."""
    readout, parts = 0.0, list[_Equation]()
    for tolerance in TOLERANCES:
        parts = [_Equation.of(p.pair, p.pose, readout, tolerance / focal) for p in posed]
        if tolerance == TOLERANCES[-1]:
            posed, parts = _telling(posed, parts)
        if not parts:
            break
        step = sum(p.gradient for p in parts) / (sum(p.curvature for p in parts) + 1e-12)
        step = float(np.clip(step, -LARGEST_STEP, LARGEST_STEP))
        readout = float(np.clip(readout + step, -1.5 * LONGEST, 1.5 * LONGEST))
        posed = [
            _Posed(p.pair, p.pose.stepped(part.step(step)))
            for p, part in zip(posed, parts, strict=True)
        ]
    clips = len({p.pair.clip for p in posed})
    if clips < LEAST_CLIPS:
        return FoundReadout(clips=clips, pairs=len(posed))
    error = _standard_error([p.pair.clip for p in posed], parts)
    sure = error <= LARGEST_ERROR and readout >= LEAST_EVIDENCE * error
    believed = sure and SHORTEST <= readout <= LONGEST
    return FoundReadout(readout if believed else 0.0, readout, error, clips, len(posed))


def _telling(
    posed: list[_Posed], parts: list["_Equation"]
) -> tuple[list[_Posed], list["_Equation"]]:
    """The better half of the pairs, those in which a match says more of the readout."""
    share = np.array([part.curvature / part.weight for part in parts])
    count = max(LEAST_PAIRS, len(parts) // 2)
    keep = np.sort(np.argsort(-share, kind="stable")[:count]).tolist()
    return [posed[k] for k in keep], [parts[k] for k in keep]


@dataclass(frozen=True)
class _Equation:
    """What a pair says of the readout, whatever its motion."""

    curvature: float
    """Of the cost in the readout, 1 / s^2, the motion being what is then best."""
    gradient: float
    """Of what falls, 1 / s."""
    motion: Float[np.ndarray, "5"]
    """Its step, the readout being held."""
    by_readout: Float[np.ndarray, "5"]
    """By how much less it steps for each second that the readout grows."""
    weight: float
    """Of its matches, together, in the unit of the curvature's error^2."""
    square: float
    """Weighted sum of squared errors."""

    @staticmethod
    def of(pair: _Pair, pose: RelativePose, readout: float, tolerance: float) -> "_Equation":
        """Linearised, its matches weighted by Geman and McClure's loss."""
        small = 5e-4
        before, here, after = (pair.at_once(readout + by) for by in (-small, 0.0, small))
        error, jacobian = pose.errors(*here), pose.derivatives(*here)
        slope = (pose.errors(*after) - pose.errors(*before)) / (2 * small)
        weight = 1 / (1 + (error / tolerance) ** 2) ** 2 / tolerance**2
        weighted = jacobian * weight[:, None]
        normal = weighted.T @ jacobian
        normal += (1e-6 * np.trace(normal) + 1e-12) * np.eye(5)
        right = weighted.T @ np.stack([-error, slope], axis=1)
        motion, by_readout = np.linalg.solve(normal, right).T
        # What of the slope no motion explains.
        left = slope - jacobian @ by_readout
        return _Equation(
            float(weight @ (left * slope)),
            float(-(weight * left) @ error),
            motion,
            by_readout,
            float(weight.sum()),
            float(weight @ error**2),
        )

    def step(self, readout: float) -> Float[np.ndarray, "5"]:
        """Of the motion, where the readout takes its own."""
        return self.motion - readout * self.by_readout


def _standard_error(clips: Sequence[int], parts: Sequence[_Equation]) -> float:
    """Of the readout: by how much clips disagree, and what their matches have in common."""
    curvature = sum(part.curvature for part in parts) + 1e-12
    gradients = np.bincount(clips, [part.gradient for part in parts])
    count = len(set(clips))
    spread = np.sqrt((gradients**2).sum() * count / (count - 1)) / curvature
    # A readout's effect on a match against the error of one, root mean squares.
    common = COMMON * np.sqrt(sum(part.square for part in parts) / curvature)
    return float(np.hypot(spread, common))
