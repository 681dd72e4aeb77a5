"""Errors of a result against the truth: trajectory and surface, as numbers, files and pictures."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from geogs.application.evaluate_surface import compare_surface, photoconsistency
from geogs.application.result_settings import EvalSettings
from geogs.application.results.output_folder import claimed, read_summary
from geogs.application.results.result_page import shown_model, shown_views
from geogs.application.results.saved_result import SavedResult, load_result
from geogs.errors import InputError
from geogs.evaluation.model_view.shown_model import Colouring, Legend, Lengths, ShownModel
from geogs.evaluation.pages.evaluation_page import SAME_POSES_CM, Evaluation, write_report
from geogs.evaluation.pages.run_page import PICTURES, figures, run_figures, run_sections
from geogs.evaluation.reliability import Reliability, reliability
from geogs.evaluation.surfaces.surface import read_surface
from geogs.evaluation.surfaces.surface_errors import SurfaceComparison
from geogs.evaluation.trajectory_errors import (
    Alignment,
    TrajectoryErrors,
    doubts,
    evaluate_trajectory,
)
from geogs.evaluation.true_scene import TrueScene, read_true_scene, scaled
from geogs.guard.replacement import is_half_done, replaced
from geogs.io.pose_files import read_frame_poses, read_tum_trajectory
from geogs.io.writers.intrinsics_file import read_camera
from geogs.io.writers.uncertainty import read_states
from geogs.mesh.triangle_mesh import Mesh
from geogs.threads import on_one_torch_thread
from geogs.types import Trajectory

_ICP_PROTOCOLS = ("samples", "vertex")
"""Protocols that include an alignment by ICP."""


@on_one_torch_thread
def evaluate(settings: EvalSettings) -> Evaluation:
    """Compare, and write eval.json and report/ into the folder of the result.

    Raises:
        InputError: the result or the truth cannot be read, or they have too little in common.
        OutputError: a file cannot be written.
    """
    folder = settings.output
    if not (folder / "trajectory.tum").is_file() and not is_half_done(folder):
        raise InputError(f"{folder} holds no trajectory.tum; give the folder of a result.")
    with claimed(folder) as output, replaced(output, "part") as new:
        return _evaluated(settings, new)


def _evaluated(settings: EvalSettings, new: Path) -> Evaluation:
    """The errors; ``new`` is the folder for new files of the result."""
    scene = read_true_scene(settings.gt)
    summary = _summary(settings.output)
    alignment = _alignment(settings, summary)
    frames = read_frame_poses(settings.output)
    known = frames.of("tracked" if frames.tracked.any() else "orientation only")
    trajectory = _trajectory_errors(settings, known, scene, alignment)
    keyframes = None
    if (settings.output / "keyframes.tum").is_file():
        with suppress(InputError):  # too few of them to align
            mapped = read_tum_trajectory(settings.output / "keyframes.tum")
            keyframes = _trajectory_errors(settings, mapped, scene, alignment)
    mesh_file, points_file = find_surface(settings) if settings.surface else (None, None)
    surface = None
    photo = None
    if (settings.output / "mesh.ply").is_file() and (settings.surface or settings.photo):
        mesh = read_surface(settings.output / "mesh.ply").transformed(trajectory.T_ref_est)
        if settings.surface:
            surface = compare_surface(settings, scene, mesh, mesh_file, points_file)
        photo = photoconsistency(settings, scene, mesh) if settings.photo else None
    scores = None if surface is None else surface.scores
    by_icp = settings.icp if settings.protocol == "area" else settings.protocol in _ICP_PROTOCOLS
    compared: dict[str, object] = {
        "true_poses": str(settings.gt),
        "clock_of_true_poses": scene.clock,
        "true_surface": mesh_file and str(mesh_file),
        "seen_points": points_file and str(points_file),
        "protocol": settings.protocol if scores is None else scores.protocol,
        "surface_aligned_by": f"{alignment} of all frames" + (" + ICP" * by_icp),
        "max_time_difference_s": settings.max_diff,
        "cull": settings.cull,
        "seed": settings.seed,
    }
    is_metric = str(summary.get("scale", "")).startswith("metric")
    against = doubts(trajectory, known, scene.trajectory, settings.max_diff, is_metric)
    told = _reliability(settings.output, trajectory)
    evaluation = Evaluation(trajectory, keyframes, scores, compared, photo, told, tuple(against))
    result = _saved(settings.output) if settings.plots else None
    pictures = _run_pictures(settings)
    if settings.plots:
        pictures = [*_draw(settings, new, evaluation, surface, result), *pictures]
    page = new / "report" / "index.html"
    title = str(summary.get("source", settings.output.resolve().name))
    run = run_sections(summary) if summary else []
    judged = figures(summary, run_figures(summary)[:4]) if summary else None
    model = None if result is None else _model_beside_truth(result, trajectory, surface)
    write_report(evaluation, new / "eval.json", page, pictures, run, title, judged, model)
    return evaluation


def _summary(output: Path) -> dict[str, object]:
    """The run's summary; empty if there is none that can be read."""
    try:
        return read_summary(output)
    except InputError:
        return {}


def _alignment(settings: EvalSettings, summary: dict[str, object]) -> Alignment:
    """The alignment to use: a result in the frame of known poses is compared as it is."""
    if settings.alignment != "auto":
        return settings.alignment
    return "none" if str(summary.get("scale", "")).startswith("of the poses") else "sim3"


def _trajectory_errors(
    settings: EvalSettings, found: Trajectory, scene: TrueScene, alignment: Alignment
) -> TrajectoryErrors:
    """Errors of one of the trajectories in metres; its transform maps map units to metres."""
    # A map in the frame of the true poses has their unit; for others the factor is free.
    estimate = scaled(found, scene.metres)
    errors = evaluate_trajectory(estimate, scene.trajectory, settings.max_diff, alignment)
    T = errors.T_ref_est @ np.diag([scene.metres] * 3 + [1.0])
    return replace(errors, T_ref_est=T, scale=errors.scale * scene.metres)


def _reliability(output: Path, errors: TrajectoryErrors) -> Reliability | None:
    """Compare the frames' errors with the run's standard deviations; none where it gave none.

    These are for errors after alignment by a similarity; other alignments have no comparison.
    """
    table = output / "trajectory_uncertainty.csv"
    if errors.alignment != "sim3" or not table.is_file():
        return None
    known = np.array([(t, s) for t, state, s in read_states(table) if state == "tracked"])
    times, sigma = known.reshape(-1, 2).T
    return reliability(errors.timestamps, errors.position_error, times, errors.scale * sigma)


def find_surface(settings: EvalSettings) -> tuple[Path | None, Path | None]:
    """Files of the true mesh and the seen points: as given, else beside the poses or above."""
    for path in (settings.gt_mesh, settings.gt_points):
        if path is not None and not path.is_file():
            raise InputError(f"{path} does not exist; give a PLY file.")
    folder = (settings.gt if settings.gt.is_dir() else settings.gt.parent).resolve()
    mesh = settings.gt_mesh
    points = settings.gt_points
    own = settings.output.resolve()  # whose mesh is no truth
    for place in (place for place in (folder, folder.parent) if place != own):
        names = ["mesh.ply", f"{folder.name}_mesh.ply", "mesh_*.ply", "tsdf_pseudo_gt.ply"]
        found = [path for name in names for path in sorted(place.glob(name))]
        mesh = mesh or next(iter(found), None)
        if settings.gt_mesh is None:
            points = points or next(iter(sorted(place.glob("points_seen_*.ply"))), None)
    return mesh or points, points


def _saved(folder: Path) -> SavedResult | None:
    """The result; none where no map was saved, or it cannot be read."""
    try:
        result = load_result(folder)
        result.upright  # noqa: B018  # reads trajectory and mesh
    except InputError:
        return None
    return result


def _draw(
    settings: EvalSettings,
    new: Path,
    evaluation: Evaluation,
    surface: SurfaceComparison | None,
    result: SavedResult | None,
) -> list[tuple[str, Path]]:
    """Draw the pictures of this command. Returns their titles and files."""
    from geogs.evaluation.pages import plots
    from geogs.evaluation.pages.shading import viewpoints

    folder = new / "report"
    titles: dict[str, str] = {}
    trajectory = evaluation.trajectory
    up = None if result is None else trajectory.T_ref_est[:3, :3] @ result.upright.axes[2]
    if trajectory.ate_max_cm > SAME_POSES_CM:
        plots.plot_trajectory(folder / "trajectory_truth.png", trajectory, up)
        plots.plot_error_over_time(folder / "trajectory_error.png", trajectory)
        titles["trajectory_truth.png"] = "Trajectory over the truth"
        titles["trajectory_error.png"] = "Error over time"
    if evaluation.reliability is not None:
        plots.plot_reliability(folder / "reliability.png", evaluation.reliability)
        titles["reliability.png"] = "Are errors as large as predicted?"
    if surface is not None:
        camera = read_camera(settings.output / "intrinsics.json")
        views = viewpoints(surface.mesh.vertices, trajectory.aligned, camera, up)
        plots.plot_beside_truth(folder / "mesh_truth.png", surface, views)
        titles = {"mesh_truth.png": "Surface beside the truth", **titles}
    return [(title, folder / name) for name, title in titles.items()]


def _run_pictures(settings: EvalSettings) -> list[tuple[str, Path]]:
    """Pictures drawn by the run, without truth; titles and files."""
    return [(title, settings.output / "report" / name) for name, title in PICTURES.items()]


def _model_beside_truth(
    result: SavedResult, trajectory: TrajectoryErrors, surface: SurfaceComparison | None
) -> ShownModel:
    """The model for the page of an evaluated result.

    Args:
        result: the result.
        trajectory: its errors in metres, with the similarity from the map to the truth.
        surface: the comparison of its mesh, in metres, if there is one.
    """
    from geogs.evaluation.pages.plots import ERROR_STOPS, error_colours

    T = trajectory.T_ref_est

    def coloured(mesh: Mesh) -> Sequence[Colouring]:
        if surface is None:
            return ()
        vertices = mesh.vertices @ T[:3, :3].T + T[:3, 3]
        colours = error_colours(vertices, surface)
        limit = surface.scores.colour_limit_cm
        ends = ("0", f"{float(f'{limit:.2g}'):g} cm and more")
        legend = Legend("Distance to the truth", ends, ERROR_STOPS, "grey: not compared")
        return [Colouring("Error", colours, legend)]

    back = np.linalg.inv(T)
    true_path = trajectory.truth[:, :3, 3] @ back[:3, :3].T + back[:3, 3]
    disks = result.disks
    unit = Lengths(trajectory.scale, "Metres, by comparison with the truth.")
    frames = result.trajectory
    camera = result.camera
    views = shown_views(result)
    renders = result.renders
    return shown_model(
        frames, views, camera, result.mesh, disks, unit, coloured, true_path, renders
    )
