"""Errors of a result against the truth: trajectory and surface, tables and pictures."""

from geogs.evaluation.reconstruction import (
    ReconstructionScores,
    SurfaceErrors,
    evaluate_reconstruction,
)
from geogs.evaluation.surface import Surface, read_surface
from geogs.evaluation.trajectory import TrajectoryErrors, evaluate_trajectory
from geogs.evaluation.visibility import Visibility

__all__ = [
    "ReconstructionScores",
    "Surface",
    "SurfaceErrors",
    "TrajectoryErrors",
    "Visibility",
    "evaluate_reconstruction",
    "evaluate_trajectory",
    "read_surface",
]
