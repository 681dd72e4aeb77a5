"""Scores of a camera's estimated motion: fraction of the frames, positions, orientations."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from geogs.errors import InputError
from geogs.evaluation.rotation_errors import best_rotation, rotation_angle
from geogs.evaluation.trajectory_errors import (
    associate,
    evaluate_trajectory,
    extent_of,
    finite_poses,
)
from geogs.types import Trajectory
from geogs_bench.data.benchmark_scene import BenchmarkScene
from geogs_bench.data.true_poses import SAME_TIME, read_true_poses
from geogs_bench.results.record import MotionScore
from geogs_bench.results.result_folder import ResultFolder

_LEAST_PATH = 0.05
"""Least length of the path for a comparison of positions, metres."""
_MOST_OFF = 0.05
"""Largest ATE of a reliable run, as a fraction of the extent of the true path (root of the mean
squared distance from its middle)."""
_LEAST_FOLLOWED = 80.0
"""Least percentage of frames of which a reliable run gives the pose, or the orientation marked as
such."""


def score_motion(scene: BenchmarkScene, result: ResultFolder) -> MotionScore:
    """Score the final trajectory of a result against the scene's true one.

    Raises:
        InputError: either cannot be read.
    """
    reference = read_true_poses(scene)
    if reference is None:
        raise InputError(f"{scene.name} has no true poses to compare with.")
    estimate = result.poses()
    claim = (result.summary.get("verdict") or {}).get("is_reliable")
    if estimate is None:
        return MotionScore(tracked=0.0, is_called_reliable=claim)
    tracked = estimate.of("tracked")
    states = result.states()
    turned = sum(state == "orientation only" for _, state, _ in states)
    return replace(
        compare_motion(reference, tracked, estimate),
        turned=100 * turned / max(len(states), 1),
        within=_within(reference, tracked, states) if states else None,
        is_called_reliable=claim,
    )


def compare_motion(reference: Trajectory, tracked: Trajectory, oriented: Trajectory) -> MotionScore:
    """Compare the tracked poses with the true ones, frame by frame.

    Positions are aligned by a Sim(3), orientations by the best-fitting rotation, so that a camera
    that only rotates has a rotation error, too. ``oriented`` are the poses whose orientation
    counts.
    """
    reference, tracked, oriented = map(finite_poses, (reference, tracked, oriented))
    i, j = associate(reference.timestamps, tracked.timestamps, SAME_TIME)
    percentage = 100 * len(i) / len(reference.timestamps)
    score = MotionScore(percentage, rotation=_rotation(reference, oriented))
    true = reference.T_wc[i, :3, 3]
    found = tracked.T_wc[j, :3, 3]
    path = float(np.linalg.norm(np.diff(true, axis=0), axis=1).sum())
    if len(i) < 3 or path < _LEAST_PATH or (found == found[0]).all():
        return score
    try:
        ate = evaluate_trajectory(tracked, reference, SAME_TIME).ate_rmse_cm
    except InputError:  # they are on a line
        return score
    turned = len(oriented.timestamps) - len(i)
    followed = percentage + 100 * turned / len(reference.timestamps)
    good = followed >= _LEAST_FOLLOWED and is_near(ate, reference.T_wc[i])
    return replace(score, ate=ate, relative=ate / path, is_reliable=good)


def is_near(ate_cm: float, T_wc: Float[np.ndarray, "n 4 4"]) -> bool:
    """Whether an ATE is small enough for a reliable run; ``T_wc`` are the true poses, in metres."""
    return ate_cm <= 100 * _MOST_OFF * extent_of(T_wc)


def _rotation(reference: Trajectory, oriented: Trajectory) -> float | None:
    """RMSE of the orientations in degrees; none if there are fewer than three."""
    i, j = associate(reference.timestamps, oriented.timestamps, SAME_TIME)
    if len(i) < 3:
        return None
    return rotation_error(oriented.T_wc[j, :3, :3], reference.T_wc[i, :3, :3])


def _within(
    reference: Trajectory, tracked: Trajectory, states: list[tuple[float, str, float]]
) -> float | None:
    """Percent of the aligned positions with errors of at most three standard deviations."""
    try:
        errors = evaluate_trajectory(tracked, reference, SAME_TIME)
    except InputError:
        return None
    times, _, sigma = zip(*states, strict=True)
    claimed = errors.scale * np.interp(errors.timestamps, times, sigma)
    return 100 * float((errors.position_error <= 3 * claimed).mean())


def rotation_error(
    estimate: Float[np.ndarray, "n 3 3"], truth: Float[np.ndarray, "n 3 3"]
) -> float:
    """RMS angle in degrees after the rotation of the world that fits best (chordal mean)."""
    aligned = best_rotation(estimate, truth) @ estimate
    return float(np.sqrt((rotation_angle(aligned, truth) ** 2).mean()))
