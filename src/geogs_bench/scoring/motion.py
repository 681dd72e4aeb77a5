"""How well a camera's motion was followed: share of the frames, positions, orientations."""

import numpy as np
from jaxtyping import Float

from geogs.errors import InputError
from geogs.evaluation.trajectory import associate, evaluate_trajectory, finite_poses, rotation_angle
from geogs.types import Trajectory
from geogs_bench.record import MotionScore
from geogs_bench.result import ResultFolder
from geogs_bench.scene import Scene
from geogs_bench.truth import read_true_poses

_LEAST_PATH = 0.05
"""Metres of way below which positions have nothing to be compared with."""
_SAME_TIME = 0.005
"""Seconds."""


def score_motion(scene: Scene, result: ResultFolder) -> MotionScore:
    """The final trajectory of a result against the scene's true one.

    Raises:
        InputError: either cannot be read.
    """
    reference = read_true_poses(scene)
    if reference is None:
        raise InputError(f"{scene.name} has no true poses to compare with.")
    estimate = result.trajectory("final")
    if estimate is None:
        return MotionScore(tracked=0.0)
    return compare_motion(reference, _without_lost(estimate, result))


def compare_motion(reference: Trajectory, tracked: Trajectory) -> MotionScore:
    """The poses that were tracked against the true ones, frame by frame.

    Positions are aligned by a Sim(3), orientations by the rotation that fits them best, so that a
    camera that only turns has a rotation error, too.
    """
    reference, tracked = finite_poses(reference), finite_poses(tracked)
    i, j = associate(reference.timestamps, tracked.timestamps, _SAME_TIME)
    share = 100 * len(i) / len(reference.timestamps)
    if len(i) < 3:
        return MotionScore(share)
    rotation = rotation_error(tracked.T_wc[j, :3, :3], reference.T_wc[i, :3, :3])
    steps = np.linalg.norm(np.diff(reference.T_wc[i, :3, 3], axis=0), axis=1)
    path = float(steps.sum())
    if path < _LEAST_PATH:
        return MotionScore(share, rotation)
    try:
        ate = evaluate_trajectory(tracked, reference, _SAME_TIME).ate_rmse_cm
    except InputError:  # all estimated positions are one
        return MotionScore(share, rotation)
    return MotionScore(share, rotation, ate, ate / path)


def rotation_error(
    estimate: Float[np.ndarray, "n 3 3"], truth: Float[np.ndarray, "n 3 3"]
) -> float:
    """RMS angle in degrees after the rotation of the world that fits best (chordal mean)."""
    u, _, vt = np.linalg.svd((truth @ estimate.transpose(0, 2, 1)).sum(0))
    aligned = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt @ estimate
    return float(np.sqrt((rotation_angle(aligned, truth) ** 2).mean()))


def _without_lost(estimate: Trajectory, result: ResultFolder) -> Trajectory:
    """The poses that are not only interpolated, by the result's own summary."""
    keep = np.ones(len(estimate.timestamps), bool)
    for first, last in result.summary.get("lost_spans", []):
        keep &= (estimate.timestamps < first - 1e-6) | (estimate.timestamps > last + 1e-6)
    return Trajectory(estimate.timestamps[keep], estimate.T_wc[keep], estimate.tracked[keep])
