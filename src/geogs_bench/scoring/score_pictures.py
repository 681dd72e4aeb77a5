"""Pictures of one result beside the truth, in the report folder of the result."""

import numpy as np
from jaxtyping import Float

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
"""File in the report of a result, and title, of everything that a benchmark shows of it."""


def draw(errors: StageErrors, result: ResultFolder, T_wc: Float[np.ndarray, "k 4 4"]) -> None:
    """Draw what the errors of a stage allow; ``T_wc`` are cameras in the truth's frame.

    Raises:
        OutputError: they cannot be written.
    """
    folder = result.path / "report"
    if errors.trajectory is not None:
        plots.plot_trajectory(folder / "bench_trajectory.png", errors.trajectory)
    if errors.comparison is not None:
        views = viewpoints(errors.comparison.mesh.vertices, T_wc, result.camera)
        plots.plot_beside_truth(folder / "bench_surface.png", errors.comparison, views)
