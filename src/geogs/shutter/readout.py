"""How long a rolling shutter takes to read an image, told by the video itself.

Points are followed through clips of neighbouring images, and each clip is adjusted as a whole:
poses, points, and one readout for all (``row_adjustment.py``). What tells it is that the velocity
of a camera changes from image to image, and with it by how much rows are sheared, while the scene
stays the same. Errors of the matches change slowly and are hardly taken for it.
"""

import functools
import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from geogs.shutter.camera import RollingCamera
from geogs.shutter.clip_tracks import ClipTracks, clip_tracks
from geogs.shutter.first_reconstruction import first_reconstruction
from geogs.shutter.neighbours import Image
from geogs.shutter.reconstruction import Reconstruction
from geogs.shutter.row_adjustment import ReadoutEquation, readout_equation
from geogs.threads import thread_map

CLIP = 30
"""Neighbouring images that points are followed through."""
CLIPS = 12
"""That are worth giving, from all over the video."""
ENOUGH_CLIPS, ENOUGH = (5, 7, 9), 0.002
"""No more clips are looked at where so many leave a standard error of so many seconds."""
SURE, SMALL = 3.0, 0.01
"""Nor where the readout is less than so many seconds by so many standard errors."""
LONGEST_INTERVAL = 0.12
"""Seconds between two images; over more, nothing says how points move from one to the next."""
FIRST_TOLERANCE = 1.2
"""Pixels of an inlier between the two views that a clip begins with."""
EARLY_TOLERANCES, TOLERANCES = (4.0, 2.0, 1.2), (1.2, 0.6, 0.6, 0.3, 0.3, 0.3, 0.3, 0.3)
"""Pixels of error at which a measurement counts for a quarter, of each step of the fit: of a clip
alone as if its shutter were global, and of all together with the readout."""
LARGEST_STEP = 0.015
"""Seconds."""
SETTLED = 5e-5
"""Seconds of a step at the last tolerance after which there are no more."""
MISFIT = 1.5
"""A clip whose error is so many times the median's is left out."""
COMMON = 0.03
"""Share of the error of the matches that they have in common, and that no number of them makes
less."""
TREMOR = 0.02
"""Share of the readout that is added for tremor between the images (jerks: 2 % too much)."""

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


@dataclass(frozen=True)
class _Adjusted:
    """A clip and what is known of it so far."""

    tracks: ClipTracks
    reconstruction: Reconstruction


def find_readout(
    clips: Iterable[Sequence[Image]],
    camera: RollingCamera,
    report: Report = lambda fraction: None,
) -> FoundReadout:
    """Find the readout with which clips of a video fit best; 0 unless it is clearly better.

    Args:
        clips: ``CLIP`` neighbours in the video each; no more are taken than are needed, and the
            points of several are followed at a time.
        camera: that took them.
        report: called with the fraction done; what it raises passes through.
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
            found = _verdict(adjusted, focal)
            if found.error <= ENOUGH or found.best + SURE * found.error < SMALL:
                break
    report(1.0)
    return found if found.clips == len(adjusted) else _verdict(adjusted, focal)


def _reported(report: Report, before: int, group: int, fraction: float) -> None:
    """Tell what is done when so much is of some clips, before which there were others."""
    report(min(1.0, (before + fraction * group) / CLIPS))


def _started(clip: Sequence[Image], camera: RollingCamera) -> _Adjusted | None:
    """A clip whose points are followed and whose poses are known roughly."""
    intervals = np.diff([image.timestamp for image in clip])
    if len(clip) < CLIP or (intervals <= 0).any() or (intervals > LONGEST_INTERVAL).any():
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
        start = readout_equation(tracks, start, 0.0, tolerance / focal).stepped(start, 0.0)
    return _Adjusted(tracks, start)


def _verdict(clips: list[_Adjusted], focal: float) -> FoundReadout:
    """The readout that fits all clips best, and whether it is believed."""
    readout, parts = 0.0, list[ReadoutEquation]()
    for tolerance in TOLERANCES:
        clips = [c for c in clips if c.reconstruction.is_finite]
        if len(clips) < LEAST_CLIPS:
            return FoundReadout(clips=len(clips))
        equation = functools.partial(_equation, readout=readout, tolerance=tolerance / focal)
        parts = thread_map(equation, clips)
        clips, parts = _fitting(clips, parts)
        step = sum(p.gradient for p in parts) / (sum(p.curvature for p in parts) + 1e-12)
        step = float(np.clip(step, -LARGEST_STEP, LARGEST_STEP))
        step = float(np.clip(readout + step, -1.5 * LONGEST, 1.5 * LONGEST)) - readout
        readout += step
        clips = [
            _Adjusted(c.tracks, part.stepped(c.reconstruction, step))
            for c, part in zip(clips, parts, strict=True)
        ]
        if tolerance == TOLERANCES[-1] and abs(step) < SETTLED:
            break
    if len(parts) < LEAST_CLIPS:
        return FoundReadout(clips=len(parts))
    error = float(np.hypot(_standard_error(parts), TREMOR * readout))
    sure = error <= LARGEST_ERROR and readout >= LEAST_EVIDENCE * error
    believed = sure and SHORTEST <= readout <= LONGEST
    return FoundReadout(readout if believed else 0.0, readout, error, len(clips))


def _equation(clip: _Adjusted, readout: float, tolerance: float) -> ReadoutEquation:
    return readout_equation(clip.tracks, clip.reconstruction, readout, tolerance)


def _fitting(
    clips: list[_Adjusted], parts: list[ReadoutEquation]
) -> tuple[list[_Adjusted], list[ReadoutEquation]]:
    """Those clips that a rigid scene explains about as well as it explains most."""
    errors = np.array([np.sqrt(part.square / max(part.weight, 1e-12)) for part in parts])
    keep = np.flatnonzero(errors <= MISFIT * np.median(errors)).tolist()
    return [clips[k] for k in keep], [parts[k] for k in keep]


def _standard_error(parts: Sequence[ReadoutEquation]) -> float:
    """Of the readout: by how much clips disagree, and what their matches have in common."""
    curvature = sum(part.curvature for part in parts) + 1e-12
    gradients = np.array([part.gradient for part in parts])
    count = len(parts)
    spread = np.sqrt((gradients**2).sum() * count / (count - 1)) / curvature
    # A readout's effect on a match against the error of one, root mean squares.
    common = COMMON * np.sqrt(sum(part.square for part in parts) / curvature)
    return float(np.hypot(spread, common))
