"""Warnings on trajectory comparisons whose errors may be meaningless."""

import numpy as np

from geogs.evaluation.trajectory_errors import MAX_ROLL, TrajectoryErrors, extent_of
from geogs.types import Trajectory

FEWEST_MATCHED = 0.5
"""Least fraction of the shorter trajectory whose poses match in time."""
FEWEST_OF_ESTIMATE = 0.2
"""Least compared fraction of the estimate, where the truth has fewer poses."""
FEWEST_PAIRS = 8
"""Least number of poses; a similarity fits nearly any fewer."""
MAX_ERROR = 0.5
"""Largest error relative to the extent of the true path."""
MAX_SPEED = 150.0
"""Largest plausible speed of a camera, m/s."""
MAX_FACTOR = 1.5
"""Largest ratio of the sizes of two paths that are both given in metres."""


def doubts(
    errors: TrajectoryErrors,
    estimate: Trajectory,
    reference: Trajectory,
    max_difference: float,
    is_metric: bool,
) -> list[str]:
    """Reasons why the errors may be misleading; empty if there are none.

    Args:
        errors: errors of the following two trajectories.
        estimate: estimated poses, in any unit.
        reference: true poses, in metres.
        max_difference: largest time difference of compared poses, seconds.
        is_metric: whether the estimate claims to be in metres.
    """
    sentences = (
        _of_times(errors, estimate, reference, max_difference),
        "" if errors.alignment == "none" else _of_alignment(errors),
        _of_size(errors, is_metric or errors.alignment == "se3"),
        _of_speed(errors),
    )
    return [sentence for sentence in sentences if sentence]


def _of_times(
    errors: TrajectoryErrors, estimate: Trajectory, reference: Trajectory, max_difference: float
) -> str:
    fewer = min(errors.estimated, errors.reference)
    if errors.pairs >= FEWEST_MATCHED * fewer:
        if errors.pairs >= FEWEST_OF_ESTIMATE * errors.estimated:
            return ""
        return (
            f"Only {errors.pairs} of {errors.estimated} estimated poses are compared, since the "
            f"truth has no more than {errors.reference}, from {_span(reference)}; the estimate is "
            f"from {_span(estimate)}. Of the other poses the errors say nothing."
        )
    return (
        f"Only {errors.pairs} of {fewer} poses match in time, and nothing else is compared: the "
        f"estimate is from {_span(estimate)}, the truth from {_span(reference)}. Give true poses "
        f"by the same clock (files without times count 30 a second), or --max-diff above "
        f"{max_difference:g}."
    )


def _of_alignment(errors: TrajectoryErrors) -> str:
    if errors.pairs < FEWEST_PAIRS:
        return f"{errors.pairs} poses are so few that a similarity fits them whatever they are."
    extent = extent_of(errors.truth)
    if 0.01 * errors.ate_rmse_cm > MAX_ERROR * extent:
        return (
            f"The error is {errors.ate_rmse_cm / max(extent, 1e-9):.0f} % of the true path's "
            "extent: they have hardly anything in common, or the camera hardly moved. The "
            "alignment means nothing then, nor does what follows from it."
        )
    if errors.roll_deg > MAX_ROLL:
        return (
            "The true path is so straight that the alignment leaves the rotation about it open by "
            f"some {errors.roll_deg:.0f} degrees: rotations are compared from pose to pose, and a "
            "surface may lie turned about the path."
        )
    return ""


def _of_size(errors: TrajectoryErrors, is_metric: bool) -> str:
    ratio = max(extent_of(errors.truth), 1e-9) / max(extent_of(errors.aligned), 1e-9)
    factor = errors.scale if errors.alignment == "sim3" else ratio
    if not is_metric or 1 / MAX_FACTOR < factor < MAX_FACTOR:
        return ""
    return (
        f"The true path is {factor:.3g} times as large as the estimated one, though both should be "
        "in metres."
    )


def _of_speed(errors: TrajectoryErrors) -> str:
    seconds = float(np.ptp(errors.timestamps))
    if errors.path_length_m <= MAX_SPEED * seconds:
        return ""
    return (
        f"The true camera moves {errors.path_length_m / max(seconds, 1e-9):.0f} metres a second: "
        "true poses should be in metres, and their times in seconds."
    )


def _span(trajectory: Trajectory) -> str:
    times = trajectory.timestamps
    return f"{times.min():.6g} to {times.max():.6g} s"
