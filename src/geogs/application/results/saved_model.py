"""The model of the page of a saved result: beside a truth, errors as colours and the true path."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from geogs.application.evaluate_surface import SurfaceComparison
from geogs.application.results.saved_result import SavedResult, load_result
from geogs.application.results.shown_model import ShownView, shown_model
from geogs.errors import InputError
from geogs.evaluation.model_view.records import Colouring, Legend, Model
from geogs.evaluation.plots import ERROR_STOPS, error_colours
from geogs.evaluation.run_report import write_run_page
from geogs.evaluation.trajectory import TrajectoryErrors
from geogs.io.writers.keyframe_images import image_path, read_image
from geogs.mesh.types import Mesh


def model_beside_truth(
    folder: Path, trajectory: TrajectoryErrors, surface: SurfaceComparison | None
) -> Model | None:
    """What the page of an evaluated result shows; none where no map was saved.

    Args:
        folder: of the result.
        trajectory: its errors in metres, with the similarity that takes the map to the truth.
        surface: what its mesh was compared with, in metres, if it was.
    """
    try:
        result = load_result(folder)
        views = shown_views(result)
        mesh = result.mesh
    except InputError:
        return None
    T = trajectory.T_ref_est

    def coloured(mesh: Mesh) -> Sequence[Colouring]:
        if surface is None:
            return ()
        places = mesh.vertices @ T[:3, :3].T + T[:3, 3]
        limit = surface.scores.colour_limit_cm
        errors = 100 * surface.distance
        colours = error_colours(places, surface.points, errors, limit, surface.reach)
        ends = ("0", f"{limit:g} cm and more")
        legend = Legend("Distance to the truth", ends, ERROR_STOPS, "grey: not compared")
        return [Colouring("Error", colours, legend)]

    back = np.linalg.inv(T)
    true_path = trajectory.truth[:, :3, 3] @ back[:3, :3].T + back[:3, 3]
    disks = result.disks
    return shown_model(result.trajectory, views, result.camera, mesh, disks, coloured, true_path)


def shown_views(result: SavedResult) -> list[ShownView]:
    """The keyframes of a saved result, whose images are read when they are shown."""
    views = result.views

    def image(id: int) -> UInt8[np.ndarray, "h w 3"] | None:
        return read_image(image_path(result.folder, id)) if views.has_images else None

    return [
        ShownView(float(time), np.linalg.inv(T_cw), partial(image, int(id)))
        for id, time, T_cw in zip(views.keyframe_id, views.timestamp, views.T_cw, strict=True)
    ]


def write_page_anew(folder: Path) -> None:
    """The page of a result whose mesh is another now; where it has none, nothing.

    Raises:
        OutputError: it cannot be written.
    """
    if not (folder / "summary.json").is_file() or not (folder / "report").is_dir():
        return
    result = load_result(folder)
    mesh, disks = result.mesh, result.disks
    faces = 0 if mesh is None else len(mesh.faces)
    model = shown_model(result.trajectory, shown_views(result), result.camera, mesh, disks)
    write_run_page(folder / "report", {**result.summary, "mesh_faces": faces}, model)
