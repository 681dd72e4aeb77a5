"""All scores of a result, by the command that made it."""

from dataclasses import dataclass

import numpy as np

from geogs_bench.record import CurvePoint, MotionScore, PhotoScore, StageScore
from geogs_bench.result import ResultFolder
from geogs_bench.runner import Command
from geogs_bench.scene import Scene
from geogs_bench.scoring.judges import judge_of
from geogs_bench.scoring.motion import score_motion
from geogs_bench.scoring.photo import score_photo
from geogs_bench.scoring.pictures import draw
from geogs_bench.scoring.posed import score_posed, score_snapshots
from geogs_bench.scoring.slam import StageErrors, score_slam


@dataclass(frozen=True)
class Scores:
    """What there is to say of a result."""

    stages: tuple[StageScore, ...] = ()
    photo: PhotoScore | None = None
    motion: MotionScore | None = None
    curve: tuple[CurvePoint, ...] = ()


def score(scene: Scene, command: Command, result: ResultFolder, seed: int) -> Scores:
    """Score a result and draw it beside the truth, in its report folder.

    Raises:
        InputError: the result or the truth cannot be read, or they do not fit each other.
        OutputError: the pictures cannot be written.
    """
    if scene.kind == "motion":
        return Scores(motion=score_motion(scene, result))
    if command in ("run", "update"):
        stages = score_slam(scene, result, seed)
        _draw_last(stages, result)
        return Scores(tuple(stage.score for stage in stages))
    judge = judge_of(scene, result, seed)
    if judge is None:
        return Scores(photo=score_photo(scene, result))
    stages = score_posed(judge, result)
    _draw_last(stages, result)
    curve = score_snapshots(judge, result)
    return Scores(tuple(stage.score for stage in stages), curve=curve)


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
