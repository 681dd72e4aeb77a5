"""The errors of a result on the board."""

from dataclasses import replace
from pathlib import Path

from geogs.application.evaluate import evaluate
from geogs.application.result_settings import EvalSettings
from geogs.errors import InputError
from geogs.evaluation.pages.evaluation_page import Evaluation
from geogs.evaluation.surfaces.reconstruction_errors import ReconstructionScores
from geogs_bench.board.board_record import Outcome
from geogs_bench.results.result_folder import ResultFolder
from geogs_bench.scoring.motion_scores import is_near

_SAMPLES = 50_000
"""Samples on each surface; the standard error of a ratio is below 0.2 points."""


def with_scores(outcome: Outcome, folder: Path, truth: Path, frames: int) -> Outcome:
    """Add the errors of the result in ``folder``, whose sequence has ``frames``, to an outcome.

    Raises:
        InputError: the result or the truth cannot be read.
    """
    summary = ResultFolder(folder).summary
    found = _evaluated(folder, truth)
    errors = found.trajectory
    is_called_reliable = (summary.get("verdict") or {}).get("is_reliable")
    outcome = replace(
        outcome,
        placed=100 * errors.pairs / frames,
        ate=errors.ate_rmse_cm,
        disks=summary.get("disks"),
        triangles=summary.get("mesh_faces"),
    )
    if is_called_reliable is not None:
        is_off = not is_near(errors.ate_rmse_cm, errors.truth)
        outcome = replace(
            outcome,
            reliable=float(is_called_reliable),
            misjudged=float(is_called_reliable and is_off),
        )
    if found.reliability is not None:
        outcome = replace(outcome, error_per_sigma=found.reliability.error_per_sigma)
    surface = _surface(found)
    if surface is not None:
        outcome = replace(
            outcome,
            accuracy=surface.accuracy_cm,
            completeness=surface.completeness_ratio,
            f_score=surface.f_score,
        )
    return _with_online(outcome, folder / "online", truth)


def _with_online(outcome: Outcome, folder: Path, truth: Path) -> Outcome:
    """Add the errors of the surface at the end of the stream, if it was kept."""
    if not (folder / "mesh.ply").is_file():
        return outcome
    surface = _surface(_evaluated(folder, truth))
    if surface is None:
        return outcome
    return replace(
        outcome,
        online_accuracy=surface.accuracy_cm,
        online_completeness=surface.completeness_ratio,
        online_f_score=surface.f_score,
    )


def _evaluated(folder: Path, truth: Path) -> Evaluation:
    """Evaluate like ``geogs eval``, without its pictures."""
    return evaluate(EvalSettings(output=folder, gt=truth, samples=_SAMPLES, plots=False))


def _surface(found: Evaluation) -> ReconstructionScores | None:
    scores = found.reconstruction
    if scores is None:
        return None
    if not isinstance(scores, ReconstructionScores):
        raise InputError("the board compares surfaces by area.")
    return scores
