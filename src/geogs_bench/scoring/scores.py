"""All scores of a result, by the command that made it."""

from dataclasses import replace
from pathlib import Path

from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.evaluation.surfaces.photoconsistency import evaluate_photoconsistency
from geogs.evaluation.surfaces.surface import read_surface
from geogs.evaluation.true_scene import photographs
from geogs.io.sources.posed.posed_source import PosedSource
from geogs.io.sources.sniff import open_posed_source
from geogs.io.writers.map_file import load_map
from geogs_bench.data.benchmark_scene import BenchmarkScene
from geogs_bench.results.record import CurvePoint, PhotoScore, Record, StageScore
from geogs_bench.results.result_folder import ResultFolder
from geogs_bench.scoring.depth_pictures import DEPTH_PICTURE, draw_depths
from geogs_bench.scoring.depth_scores import score_depth
from geogs_bench.scoring.motion_scores import score_motion
from geogs_bench.scoring.score_pictures import draw
from geogs_bench.scoring.slam_scores import StageErrors, score_slam
from geogs_bench.scoring.surface_scorers import SurfaceScorer, surface_scorer

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
            points.append(CurvePoint(seconds, _disks_of(folder), scorer(mesh)[0][-1]))
    return tuple(points)


def _disks_of(folder: Path) -> int | None:
    file = folder / "map.safetensors"
    return len(load_map(file)) if file.is_file() else None


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
    found = evaluate_photoconsistency(mesh, source.camera, photographs(source), held_out)
    return PhotoScore(
        found.score, found.ncc_mean, found.ncc_median, found.coverage, found.views, found.window
    )


def _indices(source: PosedSource, listed: list[int | str]) -> list[int]:
    """Indices in the source of images that are listed by index or by file name."""
    names = {Path(source.label(i)).name: i for i in range(len(source))}
    found = [i if isinstance(i, int) else names.get(Path(i).name) for i in listed]
    return [i for i in found if i is not None and i < len(source)]
