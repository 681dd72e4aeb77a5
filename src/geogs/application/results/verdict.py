"""Verdict: whether a run is reliable, and the reason if not."""

from dataclasses import dataclass

import numpy as np

from geogs.evaluation.trajectory_errors import extent_of
from geogs.types import Trajectory, Uncertainty

MAX_POSITION_DEVIATION = 0.05
"""Largest standard deviation of the camera position, relative to the path's extent."""
MAX_SHAPE_DEVIATION = 0.15
"""Largest relative standard deviation of the best known depths, and of the focal length, whose
error makes the scene too wide or narrow: 14 % and less in rendered videos where it was right, from
16 % on where it was wrong (docs/notebook/lens.md)."""


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
        return self.depth < 0.5


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
    depth = _median(known.depth)
    rotation = float(np.degrees(_median(known.rotation)))
    # A constant lens explains all but 0.06 of the cost, estimated per-frame lenses all but 0.024
    # where they are right, and all but 0.046 where the map is wrong (docs/notebook/lens.md).
    is_changing = known.lens_change > (0.03 if known.lens_varies else 0.1)
    checks = [
        (lost <= 0.2, f"{lost:.0%} of the frames are lost"),
        (  # With more, the map is right, but covers little of the video.
            orientation_only <= 0.5,
            f"{orientation_only:.0%} of the frames have an orientation but no position",
        ),
        (
            position <= MAX_POSITION_DEVIATION,
            _expected(position, "position error is {:.0%} of the path's size", "positions"),
        ),
        (
            depth <= MAX_SHAPE_DEVIATION,
            _expected(depth, "error of the best depths is {:.0%}", "depths"),
        ),
        (
            known.focal <= MAX_SHAPE_DEVIATION,
            f"the focal length is uncertain by {known.focal:.0%}: give --intrinsics"
            if known.focal < 10
            else "the focal length could not be estimated: give --intrinsics",
        ),
        (
            is_explained or known.focal > MAX_SHAPE_DEVIATION,
            "no camera explains the motion at the start, perhaps because much of the view moves: "
            "give --intrinsics",
        ),
        (
            known.focal_change <= 0.05,
            f"the focal length differs by {known.focal_change:.0%} between parts of the video, as "
            "with a zoom",
        ),
        (
            not is_changing,
            "the lens changes from image to image (stabilisation, focus, zoom), and the change "
            "could not be estimated",
        ),
        (  # Up to 1.29 in rendered videos with correct tracking, from 1.41 on where it had failed.
            known.misfit <= 1.35,
            f"a tenth of the keyframes fit their matches {known.misfit:.1f} times worse than the "
            "others, as when tracking fails",
        ),
        (
            known.joined >= 0.95,
            f"only {known.joined:.0%} of the keyframes form one rigid structure, as when something "
            "fills the view",
        ),
    ]
    reasons = [reason for is_good, reason in checks if not is_good]
    if reasons:
        sentence = f"Not reliable: {'; '.join(reasons)}."
    else:
        # A small fraction is given with its first digit.
        percent = f"{position:.1%}" if position >= 0.001 else f"{100 * position:.1g}%"
        sentence = (
            "Trajectory and shape are reliable. Expected position error: "
            f"{percent} of the path's size. Expected depth error: {depth:.1%}."
        )
    return Verdict(
        is_reliable=not reasons,
        sentence=sentence,
        lost=lost,
        orientation_only=orientation_only,
        position=position,
        rotation_deg=rotation,
        depth=depth,
        focal=known.focal,
        focal_change=known.focal_change,
        lens_change=known.lens_change,
        joined=known.joined,
        lens_varies=known.lens_varies or is_changing,
    )


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if len(values) else float("inf")


def _expected(deviation: float, error: str, what: str) -> str:
    """The expected error, unless it is too large to mean anything."""
    if deviation < 10:
        return f"the expected {error.format(deviation)}"
    return f"{what} could not be determined"
