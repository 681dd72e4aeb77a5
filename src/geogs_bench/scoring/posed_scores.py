"""Scores of a map from known poses: it is in the truth's frame already, so nothing is aligned."""

from pathlib import Path

from geogs.errors import InputError
from geogs.evaluation.surfaces.surface import read_surface
from geogs.io.writers.map_file import load_map
from geogs_bench.results.record import CurvePoint, StageScore
from geogs_bench.results.result_folder import ResultFolder
from geogs_bench.scoring.judges import Judge
from geogs_bench.scoring.slam_scores import StageErrors


def score_posed(judge: Judge, result: ResultFolder) -> list[StageErrors]:
    """Every stage that left a mesh. Raises InputError where none did."""
    stages = []
    for stage in result.stages():
        mesh = result.mesh(stage)
        if mesh is not None and mesh.is_mesh:
            scores, comparison = judge(mesh)
            stages.append(StageErrors(StageScore(stage, None, scores), None, comparison))
    if not stages:
        raise InputError(f"{result.path} holds no mesh to score.")
    return stages


def score_snapshots(judge: Judge, result: ResultFolder) -> tuple[CurvePoint, ...]:
    """Errors of the map after so many seconds, where the run left such snapshots."""
    points = []
    for seconds, folder in result.snapshots():
        mesh = read_surface(folder / "mesh.ply")
        if mesh.is_mesh:
            points.append(CurvePoint(seconds, _disks_of(folder), judge(mesh)[0][-1]))
    return tuple(points)


def _disks_of(folder: Path) -> int | None:
    file = folder / "map.safetensors"
    return len(load_map(file)) if file.is_file() else None
