"""Scorers of meshes in the frame of the truth: of a room, an object, a DTU scan."""

from collections.abc import Callable

import numpy as np

from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.evaluation.surfaces.dtu_errors import DtuScores, evaluate_dtu, read_dtu_reference
from geogs.evaluation.surfaces.object_errors import (
    MAX_DISTANCE,
    ObjectScores,
    evaluate_object,
)
from geogs.evaluation.surfaces.silhouettes import Silhouette, cull_by_masks
from geogs.evaluation.surfaces.surface import Surface, read_surface
from geogs.evaluation.surfaces.surface_errors import SurfaceComparison
from geogs.evaluation.true_scene import silhouettes
from geogs.io.sources.sniff import open_posed_source
from geogs_bench.data.benchmark_scene import BenchmarkScene
from geogs_bench.data.true_poses import read_true_poses
from geogs_bench.results.record import SurfaceScore
from geogs_bench.results.result_folder import ResultFolder
from geogs_bench.scoring.room_scores import read_true_surface, score_surface

SurfaceScorer = Callable[[Surface], tuple[tuple[SurfaceScore, ...], SurfaceComparison]]
"""Scores of a mesh (the one to plot last) and its errors over the surface."""

_MASK_EDGE = 1600
"""Long edge of DTU's masks, pixels."""


def surface_scorer(scene: BenchmarkScene, result: ResultFolder, seed: int) -> SurfaceScorer | None:
    """The scorer of a scene, its truth read once; none if the scene has no true surface.

    Raises:
        InputError: the truth cannot be read.
    """
    if scene.kind == "scan":
        return None if scene.truth.dtu is None else _scan_scorer(scene, seed)
    if scene.truth.surface is None:
        return None
    if scene.kind == "object":
        return _object_scorer(scene, seed)
    return _room_scorer(scene, result, seed)


def _room_scorer(scene: BenchmarkScene, result: ResultFolder, seed: int) -> SurfaceScorer:
    poses = read_true_poses(scene)
    if poses is None:
        raise InputError(f"{scene.name} has no true poses, which say what its camera saw.")
    truth = read_true_surface(scene.truth, result.camera, np.linalg.inv(poses.T_wc))
    assert truth is not None  # the caller has looked
    return lambda mesh: score_surface(mesh, truth, False, seed)


def _object_scorer(scene: BenchmarkScene, seed: int) -> SurfaceScorer:
    assert scene.truth.surface is not None  # the caller has looked
    truth = read_surface(scene.truth.surface)
    points = None if scene.truth.points is None else read_surface(scene.truth.points)
    masks = _masks(scene)

    def score(mesh: Surface) -> tuple[tuple[SurfaceScore, ...], SurfaceComparison]:
        found = evaluate_object(mesh, truth, masks, points, seed=seed)
        distance = np.minimum(found.accuracy, MAX_DISTANCE)  # those left out are infinite
        compared_at = found.reconstruction_points
        comparison = SurfaceComparison(found.scores, mesh, truth, compared_at, distance)
        return (_of_object(found.scores),), comparison

    return score


def _scan_scorer(scene: BenchmarkScene, seed: int) -> SurfaceScorer:
    assert scene.truth.dtu is not None  # the caller has looked
    reference = read_dtu_reference(scene.truth.dtu.folder, scene.truth.dtu.scan)
    masks = _masks(scene)

    def score(mesh: Surface) -> tuple[tuple[SurfaceScore, ...], SurfaceComparison]:
        found = evaluate_dtu(cull_by_masks(mesh, masks), reference, seed)
        points, distance = found.reconstruction_points, found.accuracy / 1000
        comparison = SurfaceComparison(found.scores, mesh, None, points, distance)
        return (_of_scan(found.scores),), comparison

    return score


def _masks(scene: BenchmarkScene) -> list[Silhouette]:
    """The masks of all images, dilated by DTU's protocol; empty if images have none."""
    source = open_posed_source(scene.source, InputConfig(long_edge=_MASK_EDGE))
    return [mask.dilated() for mask in silhouettes(source) or ()]


def _of_object(scores: ObjectScores) -> SurfaceScore:
    return SurfaceScore(
        weighting="area",
        unit="mm",
        accuracy=scores.accuracy_mm,
        completeness=scores.completeness_mm,
        chamfer=scores.chamfer_mm,
        ratio=scores.recall,
        precision=scores.precision,
        f_score=scores.f_score,
        threshold=scores.threshold_mm,
        accuracy_median=scores.accuracy_median_mm,
        completeness_median=scores.completeness_median_mm,
    )


def _of_scan(scores: DtuScores) -> SurfaceScore:
    return SurfaceScore(
        weighting="points",
        unit="mm",
        accuracy=scores.d2s_mm,
        completeness=scores.s2d_mm,
        chamfer=scores.overall_mm,
        accuracy_median=scores.d2s_median_mm,
        completeness_median=scores.s2d_median_mm,
    )
