"""Plots of a result and the truth, by matplotlib without a display, written as PNG."""

from collections.abc import Sequence
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, UInt8

from geogs.evaluation.held_camera import level_axes
from geogs.evaluation.pages.shading import GREY, Viewpoint, look
from geogs.evaluation.reliability import Reliability
from geogs.evaluation.surfaces.surface_errors import SurfaceComparison
from geogs.evaluation.trajectory_errors import TrajectoryErrors
from geogs.guard.atomic import atomic_file
from geogs.threads import thread_map

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_TRUTH, _ESTIMATE = "0.45", "#0072b2"
_ERROR_MAP = "YlOrRd"
ERROR_STOPS = ("#ffffcc", "#fed976", "#fd8d3c", "#e2191c", "#800026")
"""CSS colours of :func:`error_colours` from zero to the largest error."""


def plot_trajectory(
    path: Path, errors: TrajectoryErrors, up: Float[np.ndarray, "3"] | None = None
) -> None:
    """Plot the aligned estimate over the truth, from above and the side, coloured by its error.

    ``up`` is of the true world; where it is not given, it is that of the cameras.
    """
    figure = new_figure(11.0, 4.6)
    axes = level_axes(errors.truth, up)
    origin = errors.truth[:, :3, 3].mean(0)
    truth = (errors.truth[:, :3, 3] - origin) @ axes.T
    estimate = (errors.aligned[:, :3, 3] - origin) @ axes.T
    plots = []
    sides = ("from above", "forward", 1), ("from the side", "up", 2)
    for column, (name, upwards, vertical) in enumerate(sides):
        plot = figure.add_subplot(1, 2, column + 1)
        plot.plot(truth[:, 0], truth[:, vertical], color=_TRUTH, lw=2.5, label="truth")
        x = estimate[:, 0]
        y = estimate[:, vertical]
        colour = 100 * errors.position_error
        dots = plot.scatter(x, y, 7, colour, cmap="plasma", label="estimate", zorder=3)
        plot.set_aspect("equal", adjustable="datalim")
        plot.set(title=name, xlabel="right (m)", ylabel=f"{upwards} (m)")
        plot.grid(alpha=0.3)
        plot.legend(loc="best")
        plots.append(plot)
    figure.colorbar(dots, ax=plots, label="position error (cm)", shrink=0.8)
    figure.draw_without_rendering()  # fixes the limits, whose tick labels need space
    save_figure(figure, path)


def plot_error_over_time(path: Path, errors: TrajectoryErrors) -> None:
    """Plot position error in cm and rotation error in degrees against time.

    Rotation errors are absolute or relative over the stretch from each pose, see ``rotations``.
    """
    figure = new_figure(10.0, 4.2)
    order = np.argsort(errors.timestamps)
    time = errors.timestamps[order] - errors.timestamps[order[0]]
    which, rotation, rotation_rmse = errors.rotations
    rows = (
        ("position error (cm)", 100 * errors.position_error, errors.ate_rmse_cm),
        (f"{which} rotation error (deg)", rotation, rotation_rmse),
    )
    for row, (label, values, rmse) in enumerate(rows):
        plot = figure.add_subplot(2, 1, row + 1)
        plot.plot(time, values[order], color=_ESTIMATE, lw=1)
        plot.axhline(rmse, color=_TRUTH, ls="--", lw=1, label=f"RMSE {rmse:.3g}")
        plot.set_ylabel(label)
        plot.set_ylim(0, 1.15 * max(float(np.nanmax(values)), 1e-9))
        plot.margins(x=0.01)
        plot.legend(loc="upper right")
        plot.grid(alpha=0.3)
    plot.set_xlabel("time (s)")
    save_figure(figure, path)


def plot_reliability(path: Path, reliability: Reliability) -> None:
    """Plot the reliability diagram: observed over predicted fractions of the frames."""
    figure = new_figure(5.2, 4.6)
    plot = figure.add_subplot(1, 1, 1)
    predicted = np.linspace(0, 1, 201)
    plot.plot([0, 1], [0, 1], color=_TRUTH, ls="--", lw=1, label="as predicted")
    plot.plot(predicted, reliability.observed(predicted), color=_ESTIMATE, lw=2, label="observed")
    plot.text(0.03, 0.8, "above the line: errors smaller than said", color=_TRUTH)
    plot.text(0.97, 0.2, "below: larger", color=_TRUTH, ha="right")
    plot.set(xlim=(0, 1), ylim=(0, 1), aspect="equal")
    plot.set(xlabel="predicted fraction of the frames", ylabel="observed fraction of the frames")
    plot.legend(loc="lower right")
    plot.grid(alpha=0.3)
    save_figure(figure, path)


def plot_beside_truth(path: Path, compared: SurfaceComparison, views: Sequence[Viewpoint]) -> None:
    """Draw a shaded mesh, the truth if that is a mesh, and the mesh in the colours of its error.

    Each is a row, with a column for each view.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    mesh = compared.mesh
    truth = compared.truth
    sights = thread_map(partial(look, mesh.vertices, mesh.faces), views)
    rows = [("reconstruction", [sight.paint() for sight in sights])]
    if truth is not None and truth.is_mesh:
        true_sights = thread_map(partial(look, truth.vertices, truth.faces), views)
        rows.append(("truth", [sight.paint() for sight in true_sights]))
    colours = error_colours(mesh.vertices, compared)
    rows.append(("its error", [sight.paint(colours) for sight in sights]))
    camera = views[0].camera
    figure = new_figure(4.2 * len(views), 0.5 + 4.2 * camera.height / camera.width * len(rows))
    plots = []
    for row, (name, pictures) in enumerate(rows):
        for column, (view, picture) in enumerate(zip(views, pictures, strict=True)):
            plot = figure.add_subplot(len(rows), len(views), row * len(views) + column + 1)
            plot.imshow(picture)
            plot.set(xticks=[], yticks=[])
            if row == 0:
                plot.set_title(view.name)
            if column == 0:
                plot.set_ylabel(name)
            plots.append(plot)
    scale = ScalarMappable(Normalize(0.0, compared.scores.colour_limit_cm), _ERROR_MAP)
    figure.colorbar(scale, ax=plots, label="distance to the truth (cm)", shrink=0.6, pad=0.01)
    save_figure(figure, path)


def error_colours(
    vertices: Float[np.ndarray, "n 3"], compared: SurfaceComparison
) -> UInt8[np.ndarray, "n 3"]:
    """Colour of each vertex by the mean error of the three compared points nearest to it.

    Pale is 0, dark red the limit of the scores and more; vertices without a point within reach,
    which were not compared, are grey.
    """
    from matplotlib import colormaps
    from scipy.spatial import cKDTree

    k = min(3, len(compared.points))
    distance, nearest = (
        found.reshape(len(vertices), k)
        for found in cKDTree(compared.points).query(vertices, k=k, workers=-1)
    )
    errors = 100 * compared.distance
    fraction = (errors[nearest].mean(1) / compared.scores.colour_limit_cm).clip(0, 1)
    colours = (255 * colormaps[_ERROR_MAP](fraction)[:, :3]).round().astype(np.uint8)
    return np.where(distance[:, :1] <= compared.reach, colours, np.uint8(GREY))


def new_figure(width: float, height: float) -> "Figure":
    """Make a figure (size in inches) outside of pyplot and its global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: "Figure", path: Path) -> None:
    """Write a figure as PNG, completely or not at all."""
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=110, pil_kwargs={"compress_level": 3})
    with atomic_file(path) as stream:
        stream.write(buffer.getvalue())
