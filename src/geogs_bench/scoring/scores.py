"""All scores of a result, by the command that made it."""

from dataclasses import replace

import numpy as np

from geogs_bench.data.benchmark_scene import BenchmarkScene
from geogs_bench.results.record import Record
from geogs_bench.results.result_folder import ResultFolder
from geogs_bench.scoring.depth_pictures import DEPTH_PICTURE, draw_depths
from geogs_bench.scoring.depth_scores import score_depth
from geogs_bench.scoring.judges import judge_of
from geogs_bench.scoring.motion_scores import score_motion
from geogs_bench.scoring.photo_scores import score_photo
from geogs_bench.scoring.posed_scores import score_posed, score_snapshots
from geogs_bench.scoring.score_pictures import draw
from geogs_bench.scoring.slam_scores import StageErrors, score_slam


def scored(record: Record, scene: BenchmarkScene, result: ResultFolder) -> Record:
    """The record of a run with the scores of its result, drawn beside the truth in its report.

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
        _draw_last(stages, result)
        return replace(record, stages=tuple(stage.score for stage in stages))
    judge = judge_of(scene, result, seed)
    if judge is None:
        return replace(record, photo=score_photo(scene, result))
    stages = score_posed(judge, result)
    _draw_last(stages, result)
    curve = score_snapshots(judge, result)
    return replace(record, stages=tuple(stage.score for stage in stages), curve=curve)


def _draw_last(stages: list[StageErrors], result: ResultFolder) -> None:
    """Pictures of the final stage, seen from its own cameras."""
    if not stages:
        return
    last = stages[-1]
    if last.trajectory is not None:
        draw(last, result, last.trajectory.aligned)
        return
    poses = result.poses()
    draw(last, result, np.eye(4)[None] if poses is None else poses.T_wc)
