"""Verdict: whether a run is reliable, and the reason if not."""

from dataclasses import dataclass

import numpy as np

from geogs.evaluation.trajectory_errors import extent_of
from geogs.types import Trajectory, Uncertainty

MAX_LOST = 0.2
"""Largest fraction of frames without a pose in a reliable result."""
MAX_ORIENTATION_ONLY = 0.5
"""Largest fraction of frames with only an orientation in a reliable result: with more, the map is
right, but covers little of the video."""
MAX_POSITION_DEVIATION = 0.05
"""Largest standard deviation of the camera position, relative to the path's extent."""
MAX_DEPTH_DEVIATION = 0.2
"""Largest relative standard deviation of the best known depths."""
MAX_FOCAL_DEVIATION = 0.15
"""Largest relative deviation of the focal length, whose error makes the scene too wide or narrow:
14 % and less in rendered videos where it was right (docs/notebook/lens.md)."""
MAX_MISFIT = 1.35
"""Largest ratio of the residuals of a tenth of the keyframes to the others': up to 1.29 in rendered
videos with correct tracking, from 1.41 on where it had failed (docs/notebook/uncertainty.md)."""
MAX_FOCAL_CHANGE = 0.05
"""Largest relative difference of the focal lengths estimated from parts of a video
(docs/notebook/uncertainty.md)."""
MAX_LENS_CHANGE = 0.1
"""Largest reduction of the matches' cost by per-frame lenses, as a fraction; below 0.06 for a
constant lens (docs/notebook/lens.md)."""
MAX_LENS_CHANGE_LEFT = 0.03
"""The same where per-frame lenses were estimated: up to 0.024 where they are right, from 0.046 on
where the map was wrong from its start (docs/notebook/lens.md)."""
MIN_JOINED = 0.95
"""Least fraction of keyframes in one rigid structure; a few of the others may be misplaced."""
NO_SHAPE = 0.5
"""Relative deviation of the best known depths from which on there is no evidence of a surface."""


@dataclass(frozen=True)
class Verdict:
    """Reliability of a run, estimated without ground truth."""

    is_reliable: bool
    sentence: str
    """Message on the terminal."""
    lost: float
    """Fraction of the frames without pose and orientation."""
    orientation_only: float
    """Fraction of the frames of which only the orientation is known."""
    position: float
    """Median standard deviation of the camera position, relative to the extent of its path: the
    root of the mean squared distance from its middle."""
    rotation_deg: float
    """Median standard deviation of the orientation, degrees."""
    depth: float
    """Median relative deviation of depths, of the best known 15 % of what each keyframe sees."""
    focal: float = 0.0
    """Relative deviation of the focal length."""
    focal_change: float = 0.0
    """Relative difference of the focal lengths estimated from parts of the video."""
    lens_change: float = 0.0
    """Fraction of the matches' cost that is due to a lens that changes from frame to frame."""
    joined: float = 1.0
    """Fraction of the keyframes in the largest rigid structure."""
    lens_varies: bool = False
    """Whether the lens changes from frame to frame, estimated or not."""

    @property
    def has_shape(self) -> bool:
        """Whether depths are accurate enough for a surface."""
        return self.depth < NO_SHAPE


def verdict(
    trajectory: Trajectory,
    keyframes: Trajectory,
    known: Uncertainty,
    why_not: str = "",
    is_explained: bool = True,
) -> Verdict:
    """Judge the reliability of trajectory and shape.

    Args:
        trajectory: poses of all frames.
        keyframes: poses of the keyframes alone.
        known: standard deviations of the frames.
        why_not: reason why no map could be started, if so.
        is_explained: whether the self-calibration before the run explained the motion in its
            views; true where the focal length was given.
    """
    extent = extent_of(keyframes.T_wc)
    states = trajectory.states
    lost = states.count("lost") / len(states) if states else 1.0
    orientation_only = states.count("orientation only") / max(len(states), 1)
    if why_not:
        sentence = f"Rotation only: no shape. {why_not}"
        nothing = float("inf")
        return Verdict(False, sentence, lost, orientation_only, nothing, nothing, nothing)
    position = _median(known.position) / max(extent, 1e-12)
    depth, rotation = _median(known.depth), float(np.degrees(_median(known.rotation)))
    reasons = []
    if lost > MAX_LOST:
        reasons.append(f"{lost:.0%} of the frames are lost")
    if orientation_only > MAX_ORIENTATION_ONLY:
        reasons.append(f"{orientation_only:.0%} of the frames have an orientation but no position")
    if not position <= MAX_POSITION_DEVIATION:
        known_to = "the expected position error is {:.0%} of the path's size"
        reasons.append(_known_to(position, known_to, "positions could not be determined"))
    if not depth <= MAX_DEPTH_DEVIATION:
        known_to = "the expected error of the best depths is {:.0%}"
        reasons.append(_known_to(depth, known_to, "depths could not be determined"))
    if not known.focal <= MAX_FOCAL_DEVIATION:
        known_to = "the focal length is uncertain by {:.0%}"
        focal = _known_to(known.focal, known_to, "the focal length could not be estimated")
        reasons.append(f"{focal}: give --intrinsics")
    elif not is_explained:
        reasons.append(
            "no camera explains the motion at the start, perhaps because much of the view moves: "
            "give --intrinsics"
        )
    if known.focal_change > MAX_FOCAL_CHANGE:
        reasons.append(
            f"the focal length differs by {known.focal_change:.0%} between parts of the video, as "
            "with a zoom"
        )
    most = MAX_LENS_CHANGE_LEFT if known.lens_varies else MAX_LENS_CHANGE
    is_changing = known.lens_change > most
    if is_changing:
        reasons.append(
            "the lens changes from image to image (stabilisation, focus, zoom), and the change "
            "could not be estimated"
        )
    if known.misfit > MAX_MISFIT:
        reasons.append(
            f"a tenth of the keyframes fit their matches {known.misfit:.1f} times worse than the "
            "others, as when tracking fails"
        )
    if known.joined < MIN_JOINED:
        reasons.append(
            f"only {known.joined:.0%} of the keyframes form one rigid structure, as when something "
            "fills the view"
        )
    if reasons:
        sentence = f"Not reliable: {'; '.join(reasons)}."
    else:
        sentence = (
            "Trajectory and shape are reliable. Expected position error: "
            f"{_finely(position)} of the path's size. Expected depth error: {depth:.1%}."
        )
    return Verdict(
        not reasons, sentence, lost, orientation_only, position, rotation, depth, known.focal,
        known.focal_change, known.lens_change, known.joined, known.lens_varies or is_changing,
    )  # fmt: skip


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if len(values) else float("inf")


def _finely(value: float) -> str:
    """Format a fraction in percent; a small one with its first digit."""
    return f"{value:.1%}" if value >= 0.001 else f"{100 * value:.1g}%"


def _known_to(deviation: float, known: str, unknown: str) -> str:
    """The clause ``known`` or, where a deviation is too large to mean anything, ``unknown``."""
    return known.format(deviation) if deviation < 10 else unknown
