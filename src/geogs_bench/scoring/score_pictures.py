"""Pictures of one result beside the truth, in the report folder of the result."""

from collections.abc import Sequence

import numpy as np

from geogs.evaluation.pages import plots
from geogs.evaluation.pages.shading import viewpoints
from geogs_bench.results.result_folder import ResultFolder
from geogs_bench.scoring.depth_pictures import DEPTH_PICTURE, DEPTH_TITLE
from geogs_bench.scoring.slam_scores import StageErrors

PICTURES = {
    DEPTH_PICTURE: DEPTH_TITLE,
    "bench_surface.png": "surface, truth and error",
    "bench_trajectory.png": "trajectory",
    "keyframes.png": "renders",
}
"""File in the report of a result, and title, of every picture of a benchmark."""


def draw(stages: Sequence[StageErrors], result: ResultFolder) -> None:
    """Draw the pictures that the errors of the last stage allow, seen from its own cameras.

    Raises:
        OutputError: they cannot be written.
    """
    if not stages:
        return
    trajectory = stages[-1].trajectory
    comparison = stages[-1].comparison
    folder = result.path / "report"
    poses = result.poses()
    T_wc = np.eye(4)[None] if poses is None else poses.T_wc
    if trajectory is not None:
        plots.plot_trajectory(folder / "bench_trajectory.png", trajectory)
        T_wc = trajectory.aligned
    if comparison is not None:
        views = viewpoints(comparison.mesh.vertices, T_wc, result.camera)
        plots.plot_beside_truth(folder / "bench_surface.png", comparison, views)
