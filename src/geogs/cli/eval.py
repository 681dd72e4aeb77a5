"""``geogs eval OUT --gt PATH``: errors of a result against the truth."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from geogs.cli.options import Positional, parse_options
from geogs.config import Seed
from geogs.config.setting import Count, Positive, Range, Settings
from geogs.errors import InputError

if TYPE_CHECKING:
    from geogs.cli.eval_surface import SurfaceComparison
    from geogs.evaluation.page import Section
    from geogs.evaluation.report import Evaluation
    from geogs.evaluation.trajectory import Alignment, TrajectoryErrors
    from geogs.evaluation.truth import TrueScene


@dataclass(frozen=True)
class EvalOptions(Settings):
    """Compare a result with the truth: trajectory, and surface where a true one is found.

    Writes eval.json and report/ into the result's folder and prints the table.
    """

    output: Annotated[Path, Positional()]
    """Folder of a result, as ``geogs run`` writes it."""
    gt: Path
    """True poses: a TUM file, a traj.txt of 4x4 rows (row k is at k / 30 s), or the folder of a
    Replica, TUM, 7-Scenes or synthetic sequence, or of images with known poses (COLMAP, DTU...);
    the true surface is then found, too."""
    protocol: Literal["area", "samples", "vertex", "object", "dtu"] = "area"
    """How surfaces are compared: by area with exact distances, area-weighted from samples to
    samples (NICE-SLAM), vertex-weighted (Splat-SLAM, HI-SLAM2), a single object inside its masks
    in mm, or DTU's in mm."""
    gt_mesh: Path | None = None
    """True surface as PLY in metres, in the frame of the true poses."""
    gt_points: Path | None = None
    """Points of the true surface that the camera saw, PLY; completeness is then measured on
    them."""
    surface: bool = True
    """Compare the surface too."""
    cull: bool = False
    """Count only what the true cameras saw of the surfaces (frustum and occlusion)."""
    cull_rule: Literal["frustum", "occlusion"] = "frustum"
    """How the samples and vertex protocols cull meshes: NICE-SLAM's rule or Neural RGB-D's."""
    cull_every: Count = 10
    """Use every so many true poses for culling."""
    icp: bool = False
    """Refine the alignment of the surface by ICP (0.1 m), as Replica's usual scripts do; the
    samples and vertex protocols always do."""
    max_diff: Positive = 0.02
    """Largest time between poses that are compared, seconds."""
    alignment: Literal["auto", "sim3", "se3", "none"] = "auto"
    """Auto takes Sim(3), as the scale of monocular results is arbitrary, but leaves what was made
    with known poses as it is."""
    threshold: Positive | None = None
    """Distance that counts as reached, metres; 0.05, for objects 0.001."""
    samples: Annotated[int | None, Range(1, 1_000_000_000)] = None
    """Points on each surface; 200 000, for objects 4 000 000."""
    dtu_data: Path | None = None
    """Folder of the official DTU evaluation, with ObsMask and Points/stl."""
    dtu_scan: Annotated[int | None, Range(1, 1000)] = None
    """Number of the scan; by the name of the folder of the poses if none is given."""
    photo: bool = False
    """Measure how well the images beside the true poses agree on the surface (no truth needed)."""
    photo_every: Count = 8
    """In every so many images, which the result should not have used."""
    seed: Seed = 0
    """Of the sampling."""
    plots: bool = True
    """Draw the pictures of the report."""


def main(argv: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    evaluate(parse_options(EvalOptions, argv, "eval"))
    return 0


def evaluate(options: EvalOptions) -> "Evaluation":
    """Compare, write eval.json and report/, print the table."""
    import torch
    from rich.console import Console

    from geogs.cli.eval_surface import compare_surface, photoconsistency
    from geogs.evaluation.report import Evaluation, table, write_report
    from geogs.evaluation.surface import read_surface
    from geogs.evaluation.truth import read_true_scene

    torch.set_num_threads(1)  # the kernels have threads of their own; see geogs.threads
    _check(options)
    scene = read_true_scene(options.gt)
    summary = _summary(options.output)
    alignment = _alignment(options, summary)
    trajectory = _trajectory_errors(options, "trajectory.tum", scene, alignment)
    keyframes = None
    if (options.output / "keyframes.tum").is_file():
        try:
            keyframes = _trajectory_errors(options, "keyframes.tum", scene, alignment)
        except InputError:  # too few of them to align
            keyframes = None
    mesh_file, points_file = find_surface(options) if options.surface else (None, None)
    surface, photo = None, None
    if (options.output / "mesh.ply").is_file() and (options.surface or options.photo):
        mesh = read_surface(options.output / "mesh.ply").transformed(trajectory.T_ref_est)
        if options.surface:
            surface = compare_surface(options, scene, mesh, mesh_file, points_file)
        photo = photoconsistency(options, scene, mesh) if options.photo else None
    icp = options.icp if options.protocol == "area" else options.protocol in ("samples", "vertex")
    settings = {
        "true_poses": str(options.gt),
        "true_surface": mesh_file and str(mesh_file),
        "seen_points": points_file and str(points_file),
        "protocol": options.protocol if surface is None else surface.scores.protocol,
        "surface_aligned_by": f"{alignment} of all frames" + (" + ICP" * icp),
        "max_time_difference_s": options.max_diff,
        "cull": options.cull,
        "seed": options.seed,
    }
    result = Evaluation(
        trajectory, keyframes, None if surface is None else surface.scores, settings, photo
    )
    pictures = _draw(options, trajectory, surface) if options.plots else _run_pictures(options)
    page = options.output / "report" / "index.html"
    title = str(summary.get("source", options.output.resolve().name))
    run = _run_sections(summary)
    write_report(result, options.output / "eval.json", page, pictures, run, title)
    Console().print(table(result))
    return result


def _check(options: EvalOptions) -> None:
    counts = (options.cull_every, options.photo_every, options.samples)
    if any(n is not None and n < 1 for n in counts) or (
        options.threshold is not None and not options.threshold > 0
    ):
        raise InputError("cull-every, photo-every, samples and threshold must be positive.")
    if not (options.output / "trajectory.tum").is_file():
        raise InputError(f"{options.output} holds no trajectory.tum; give the folder of a result.")


def _summary(output: Path) -> dict[str, object]:
    """What the run said of itself; nothing if it left no summary that can be read."""
    try:
        content = json.loads((output / "summary.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _alignment(options: EvalOptions, summary: dict[str, object]) -> "Alignment":
    """The alignment to use: a result in the frame of known poses is compared as it is."""
    if options.alignment != "auto":
        return options.alignment
    return "none" if str(summary.get("scale", "")).startswith("of the poses") else "sim3"


def _trajectory_errors(
    options: EvalOptions, name: str, scene: "TrueScene", alignment: "Alignment"
) -> "TrajectoryErrors":
    """Errors of one of the trajectories in metres; its transform takes the map's unit to them."""
    import numpy as np

    from geogs.evaluation.trajectory import evaluate_trajectory
    from geogs.evaluation.truth import scaled
    from geogs.io.poses import read_tum_trajectory

    # A map in the frame of the true poses has their unit; for others the factor is free.
    estimate = scaled(read_tum_trajectory(options.output / name), scene.metres)
    errors = evaluate_trajectory(estimate, scene.trajectory, options.max_diff, alignment)
    T = errors.T_ref_est @ np.diag([scene.metres] * 3 + [1.0])
    return replace(errors, T_ref_est=T, scale=errors.scale * scene.metres)


def _run_sections(summary: dict[str, object]) -> "list[Section]":
    from geogs.evaluation.run_report import run_sections

    return run_sections(summary) if summary else []


def find_surface(options: EvalOptions) -> tuple[Path | None, Path | None]:
    """Files of the true mesh and the seen points: as given, else beside the poses or above."""
    for path in (options.gt_mesh, options.gt_points):
        if path is not None and not path.is_file():
            raise InputError(f"{path} does not exist; give a PLY file.")
    folder = (options.gt if options.gt.is_dir() else options.gt.parent).resolve()
    mesh, points = options.gt_mesh, options.gt_points
    for place in (folder, folder.parent):
        names = ["mesh.ply", f"{folder.name}_mesh.ply", "mesh_*.ply", "tsdf_pseudo_gt.ply"]
        found = [path for name in names for path in sorted(place.glob(name))]
        mesh = mesh or next(iter(found), None)
        if options.gt_mesh is None:
            points = points or next(iter(sorted(place.glob("points_seen_*.ply"))), None)
    return mesh or points, points


def _draw(
    options: EvalOptions, trajectory: "TrajectoryErrors", surface: "SurfaceComparison | None"
) -> list[tuple[str, Path]]:
    """Pictures of this command, then those that the run left; titles and files."""
    from geogs.evaluation import plots
    from geogs.evaluation.report import SAME_POSES_CM
    from geogs.evaluation.shading import viewpoints
    from geogs.io.writers.intrinsics import read_camera

    folder = options.output / "report"
    titles: dict[str, str] = {}
    if trajectory.ate_max_cm > SAME_POSES_CM:
        plots.plot_trajectory(folder / "trajectory_truth.png", trajectory)
        plots.plot_error_over_time(folder / "trajectory_error.png", trajectory)
        titles["trajectory_truth.png"] = "Trajectory over the truth"
        titles["trajectory_error.png"] = "Error over time"
    if surface is not None:
        mesh, truth, limit = surface.mesh, surface.truth, surface.scores.colour_limit_cm
        camera = read_camera(options.output / "intrinsics.json")
        colours = plots.error_colours(
            mesh.vertices, surface.points, 100 * surface.distance, limit, surface.reach
        )
        views = viewpoints(mesh.vertices, trajectory.aligned, camera)
        plots.plot_beside_truth(folder / "mesh_truth.png", mesh, truth, colours, views, limit)
        titles = {"mesh_truth.png": "Surface beside the truth", **titles}
    own = [(title, folder / name) for name, title in titles.items()]
    return own + _run_pictures(options)


def _run_pictures(options: EvalOptions) -> list[tuple[str, Path]]:
    """What the run drew without knowing the truth; titles and files."""
    from geogs.evaluation.run_report import PICTURES

    return [(title, options.output / "report" / name) for name, title in PICTURES.items()]
