"""Scores of a SLAM result: trajectory and surface of every stage, aligned by a Sim(3)."""

from dataclasses import dataclass

import numpy as np

from geogs.errors import InputError
from geogs.evaluation.surfaces.surface_errors import SurfaceComparison
from geogs.evaluation.trajectory_errors import TrajectoryErrors, evaluate_trajectory
from geogs.types import Trajectory
from geogs_bench.data.benchmark_scene import BenchmarkScene
from geogs_bench.data.true_poses import read_true_poses
from geogs_bench.results.record import StageName, StageScore, SurfaceScore, TrajectoryScore
from geogs_bench.results.result_folder import ResultFolder
from geogs_bench.scoring.room_scores import TrueSurface, read_true_surface, score_surface


@dataclass(frozen=True)
class StageErrors:
    """A stage with the errors behind its scores."""

    score: StageScore
    trajectory: TrajectoryErrors | None = None
    comparison: SurfaceComparison | None = None


def score_slam(scene: BenchmarkScene, result: ResultFolder, seed: int) -> list[StageErrors]:
    """Score every stage with files against the truth of the scene.

    Each is aligned by the Sim(3) of its own trajectory over all frames; surfaces are then refined
    by a rigid ICP, as in the scripts behind the published tables.

    Raises:
        InputError: the truth or the result cannot be read, or they have no poses in common.
    """
    reference = read_true_poses(scene)
    if reference is None:
        raise InputError(f"{scene.name} has no true poses to compare with.")
    surface = read_true_surface(scene.truth, result.camera, np.linalg.inv(reference.T_wc))
    return [_stage(result, stage, reference, surface, seed) for stage in result.stages()]


def _stage(
    result: ResultFolder,
    stage: StageName,
    reference: Trajectory,
    surface: TrueSurface | None,
    seed: int,
) -> StageErrors:
    own = result.trajectory(stage)
    estimate = own or result.poses()  # depth fusion has no trajectory of its own
    if estimate is None:
        raise InputError(f"{result.path} holds no trajectory.tum; was the run cut off?")
    errors = evaluate_trajectory(estimate, reference)
    trajectory = None
    if own is not None:
        keyframes = result.trajectory(stage, "keyframes.tum")
        rigid = None
        if result.summary.get("metric_scale") is not None:
            rigid = evaluate_trajectory(own, reference, alignment="se3").ate_rmse_cm
        trajectory = TrajectoryScore(
            errors.ate_rmse_cm, errors.pairs, errors.scale, _ate(keyframes, reference), rigid
        )
    scores: tuple[SurfaceScore, ...] = ()
    comparison = None
    mesh = result.mesh(stage)
    if surface is not None and mesh is not None and mesh.is_mesh:
        scores, comparison = score_surface(mesh.transformed(errors.T_ref_est), surface, True, seed)
    return StageErrors(StageScore(stage, trajectory, scores), errors, comparison)


def _ate(keyframes: Trajectory | None, reference: Trajectory) -> float | None:
    """RMSE in cm; none if too few keyframes match to align them."""
    try:
        return None if keyframes is None else evaluate_trajectory(keyframes, reference).ate_rmse_cm
    except InputError:
        return None
