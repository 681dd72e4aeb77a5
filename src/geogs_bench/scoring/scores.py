"""All scores of a result, by the command that made it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.evaluation.surfaces.dtu_errors import DtuScores, evaluate_dtu, read_dtu_reference
from geogs.evaluation.surfaces.object_errors import MAX_DISTANCE, ObjectScores, evaluate_object
from geogs.evaluation.surfaces.photoconsistency import evaluate_photoconsistency
from geogs.evaluation.surfaces.silhouettes import Silhouette, cull_by_masks
from geogs.evaluation.surfaces.surface import Surface, read_surface
from geogs.evaluation.surfaces.surface_errors import SurfaceComparison
from geogs.evaluation.true_scene import silhouettes
from geogs.io.sources.posed.posed_source import PosedSource
from geogs.io.sources.sniff import open_posed_source
from geogs.io.writers.map_file import load_map
from geogs_bench.data.benchmark_scene import BenchmarkScene, DtuTruth
from geogs_bench.data.true_poses import read_true_poses
from geogs_bench.results.record import CurvePoint, PhotoScore, Record, StageScore, SurfaceScore
from geogs_bench.results.result_folder import ResultFolder
from geogs_bench.scoring.depth_pictures import DEPTH_PICTURE, draw_depths
from geogs_bench.scoring.depth_scores import score_depth
from geogs_bench.scoring.motion_scores import score_motion
from geogs_bench.scoring.room_scores import read_true_surface, score_surface
from geogs_bench.scoring.score_pictures import draw
from geogs_bench.scoring.slam_scores import StageErrors, score_slam

SurfaceScorer = Callable[[Surface], tuple[tuple[SurfaceScore, ...], SurfaceComparison]]
"""Scores of a mesh (the one to plot last) and its errors over the surface."""

_MASK_EDGE = 1600
"""Long edge of DTU's masks, pixels."""
_LONG_EDGE = 800


def scored(record: Record, scene: BenchmarkScene, result: ResultFolder) -> Record:
    """Add the scores of a result to the record of its run, and draw it beside the truth.

    Raises:
        InputError: the result or the truth cannot be read, or they do not fit each other.
        OutputError: the pictures cannot be written.
    """
    seed = record.provenance.seed
    if scene.kind == "motion":
        return replace(record, motion=score_motion(scene, result))
    if scene.kind == "depth":
        places, views = score_depth(scene, result)
        draw_depths(result.path / "report" / DEPTH_PICTURE, views)
        return replace(record, places=places)
    if record.provenance.command in ("run", "update"):
        stages = score_slam(scene, result, seed)
        draw(stages, result)
        return replace(record, stages=tuple(stage.score for stage in stages))
    scorer = surface_scorer(scene, result, seed)
    if scorer is None:
        return replace(record, photo=score_photo(scene, result))
    stages = score_posed(scorer, result)
    draw(stages, result)
    curve = score_snapshots(scorer, result)
    return replace(record, stages=tuple(stage.score for stage in stages), curve=curve)


def score_posed(scorer: SurfaceScorer, result: ResultFolder) -> list[StageErrors]:
    """Score every stage that has a mesh. Raises InputError if none has."""
    stages = []
    for stage in result.stages():
        mesh = result.mesh(stage)
        if mesh is not None and mesh.is_mesh:
            scores, comparison = scorer(mesh)
            stages.append(StageErrors(StageScore(stage, None, scores), None, comparison))
    if not stages:
        raise InputError(f"{result.path} holds no mesh to score.")
    return stages


def score_snapshots(scorer: SurfaceScorer, result: ResultFolder) -> tuple[CurvePoint, ...]:
    """Errors of the map over time, if the run left snapshots."""
    points = []
    for seconds, folder in result.snapshots():
        mesh = read_surface(folder / "mesh.ply")
        if mesh.is_mesh:
            file = folder / "map.safetensors"
            disks = len(load_map(file)) if file.is_file() else None
            points.append(CurvePoint(seconds, disks, scorer(mesh)[0][-1]))
    return tuple(points)


def score_photo(scene: BenchmarkScene, result: ResultFolder) -> PhotoScore:
    """Photo-consistency in the images that the run did not use (``held_out`` of its summary).

    Raises:
        InputError: the run used all images, or left no mesh, or no two views can be compared.
    """
    mesh = result.mesh("final")
    if mesh is None or not mesh.is_mesh:
        raise InputError(f"{result.path} holds no mesh to score.")
    source = open_posed_source(scene.source, InputConfig(long_edge=_LONG_EDGE))
    held_out = _indices(source, result.summary.get("held_out", []))
    if not held_out:
        raise InputError(
            f"{scene.name} has no true surface, and the run held no image out by which to judge it."
        )
    found = evaluate_photoconsistency(mesh, source.camera, list(source), held_out)
    return PhotoScore(
        found.score, found.ncc_mean, found.ncc_median, found.coverage, found.views, found.window
    )


def _indices(source: PosedSource, listed: list[int | str]) -> list[int]:
    """Indices in the source of images that are listed by index or by file name."""
    names = {Path(source.label(i)).name: i for i in range(len(source))}
    found = [i if isinstance(i, int) else names.get(Path(i).name) for i in listed]
    return [i for i in found if i is not None and i < len(source)]


def surface_scorer(scene: BenchmarkScene, result: ResultFolder, seed: int) -> SurfaceScorer | None:
    """The scorer of a scene, its truth read once; none if the scene has no true surface.

    Raises:
        InputError: the truth cannot be read.
    """
    dtu = scene.truth.dtu
    file = scene.truth.surface
    if scene.kind == "scan":
        return None if dtu is None else _scan_scorer(scene, dtu, seed)
    if file is None:
        return None
    if scene.kind == "object":
        return _object_scorer(scene, file, seed)
    poses = read_true_poses(scene)
    if poses is None:
        raise InputError(f"{scene.name} has no true poses, which say what its camera saw.")
    truth = read_true_surface(scene.truth, result.camera, np.linalg.inv(poses.T_wc))
    assert truth is not None  # the scene has a surface
    return lambda mesh: score_surface(mesh, truth, False, seed)


def _object_scorer(scene: BenchmarkScene, file: Path, seed: int) -> SurfaceScorer:
    truth = read_surface(file)
    points = None if scene.truth.points is None else read_surface(scene.truth.points)
    masks = _masks(scene)

    def score(mesh: Surface) -> tuple[tuple[SurfaceScore, ...], SurfaceComparison]:
        found = evaluate_object(mesh, truth, masks, points, seed=seed)
        distance = np.minimum(found.accuracy, MAX_DISTANCE)  # those left out are infinite
        compared_at = found.reconstruction_points
        comparison = SurfaceComparison(found.scores, mesh, truth, compared_at, distance)
        return (_of_object(found.scores),), comparison

    return score


def _scan_scorer(scene: BenchmarkScene, dtu: DtuTruth, seed: int) -> SurfaceScorer:
    reference = read_dtu_reference(dtu.folder, dtu.scan)
    masks = _masks(scene)

    def score(mesh: Surface) -> tuple[tuple[SurfaceScore, ...], SurfaceComparison]:
        found = evaluate_dtu(cull_by_masks(mesh, masks), reference, seed)
        points = found.reconstruction_points
        distance = found.accuracy / 1000
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
