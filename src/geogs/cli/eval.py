"""``geogs eval OUT --gt PATH``: errors of a result against the truth."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from geogs.cli.options import parse_options
from geogs.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from geogs.evaluation.reconstruction import SurfaceErrors
    from geogs.evaluation.report import Evaluation
    from geogs.evaluation.surface import Surface
    from geogs.evaluation.trajectory import TrajectoryErrors
    from geogs.geometry.camera import Camera
    from geogs.types import Trajectory


@dataclass(frozen=True)
class EvalOptions:
    """Compare a result with the truth: trajectory, and surface where a true one is found.

    Writes eval.json and report/ into the result's folder and prints the table.
    """

    output: Annotated[Path, tyro.conf.Positional]
    """Folder of a result, as ``geogs run`` writes it."""
    gt: Path
    """True poses: a TUM file, a traj.txt of 4x4 rows (row k is at k / 30 s), or the folder of a
    Replica, TUM, 7-Scenes or synthetic sequence, whose surface is then found too."""
    gt_mesh: Path | None = None
    """True surface as PLY in metres, in the frame of the true poses."""
    gt_points: Path | None = None
    """Points of the true surface that the camera saw, PLY; completeness is then measured on
    them."""
    surface: bool = True
    """Compare the surface too."""
    cull: bool = False
    """Count only what the true cameras saw of the surfaces (frustum and occlusion)."""
    cull_every: int = 10
    """Use every so many true poses for culling, at least 1."""
    icp: bool = False
    """Refine the alignment of the surface by ICP (0.1 m), as Replica's usual scripts do."""
    max_diff: float = 0.02
    """Largest time between poses that are compared, seconds."""
    alignment: Literal["sim3", "se3", "none"] = "sim3"
    """Sim(3) for monocular results, whose scale is arbitrary."""
    threshold: float = 0.05
    """Distance that counts as reached, metres."""
    samples: int = 200_000
    """Points on each surface."""
    seed: int = 0
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

    from geogs.evaluation.report import Evaluation, table, write_report
    from geogs.evaluation.trajectory import evaluate_trajectory
    from geogs.io.poses import read_poses, read_tum_trajectory

    torch.set_num_threads(1)  # the kernels have threads of their own; see geogs.threads
    if options.cull_every < 1 or options.samples < 1 or not options.threshold > 0:
        raise InputError("cull-every, samples and threshold must be positive.")
    if not (options.output / "trajectory.tum").is_file():
        raise InputError(f"{options.output} holds no trajectory.tum; give the folder of a result.")
    reference = read_poses(options.gt)

    def errors_of(name: str) -> "TrajectoryErrors":
        estimate = read_tum_trajectory(options.output / name)
        return evaluate_trajectory(estimate, reference, options.max_diff, options.alignment)

    trajectory = errors_of("trajectory.tum")
    keyframes = None
    if (options.output / "keyframes.tum").is_file():
        try:
            keyframes = errors_of("keyframes.tum")
        except InputError:  # too few of them to align
            keyframes = None
    mesh_file, points_file = find_surface(options) if options.surface else (None, None)
    surface, drawing = None, None
    if mesh_file is not None and (options.output / "mesh.ply").is_file():
        surface, drawing = _evaluate_surface(options, trajectory, reference, mesh_file, points_file)
    settings = {
        "true_poses": str(options.gt),
        "true_surface": mesh_file and str(mesh_file),
        "seen_points": points_file and str(points_file),
        "surface_aligned_by": f"{options.alignment} of all frames" + (" + ICP" * options.icp),
        "max_time_difference_s": options.max_diff,
        "cull": options.cull,
        "seed": options.seed,
    }
    result = Evaluation(
        trajectory, keyframes, surface.scores if surface is not None else None, settings
    )
    pictures = _draw(options, trajectory, surface, drawing) if options.plots else []
    write_report(
        result, options.output / "eval.json", options.output / "report" / "index.html", pictures
    )
    Console().print(table(result))
    return result


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


def read_camera(path: Path) -> "Camera":
    """The working camera in intrinsics.json."""
    from geogs.geometry.camera import Camera

    try:
        k = json.loads(path.read_text(encoding="utf-8"))
        fx, fy, cx, cy = (float(k[name]) for name in ("fx", "fy", "cx", "cy"))
        return Camera(fx, fy, cx, cy, int(k["width"]), int(k["height"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path} holds no camera ({error}); was it changed?") from None


def _evaluate_surface(
    options: EvalOptions,
    trajectory: "TrajectoryErrors",
    reference: "Trajectory",
    mesh_file: Path,
    points_file: Path | None,
) -> tuple["SurfaceErrors", "tuple[Surface, Surface]"]:
    """Scores, and the aligned reconstruction with the truth."""
    import numpy as np

    from geogs.evaluation.reconstruction import evaluate_reconstruction
    from geogs.evaluation.surface import read_surface
    from geogs.evaluation.visibility import Visibility

    mesh = read_surface(options.output / "mesh.ply").transformed(trajectory.T_ref_est)
    truth = read_surface(mesh_file)
    points = None if points_file is None else read_surface(points_file)
    visibility = None
    if options.cull:
        if not truth.is_mesh:
            raise InputError(f"{mesh_file} has no triangles to hide anything; leave out --cull.")
        camera = read_camera(options.output / "intrinsics.json")
        T_cw = np.linalg.inv(reference.T_wc[:: options.cull_every])
        visibility = Visibility(truth, camera, T_cw)
    errors = evaluate_reconstruction(
        mesh,
        truth,
        points,
        visibility,
        cull_reconstruction=options.cull,
        use_icp=options.icp,
        threshold=options.threshold,
        samples=options.samples,
        seed=options.seed,
    )
    return errors, (mesh, truth)


def _draw(
    options: EvalOptions,
    trajectory: "TrajectoryErrors",
    surface: "SurfaceErrors | None",
    meshes: "tuple[Surface, Surface] | None",
) -> list[tuple[str, Path]]:
    """Pictures of this command, then those that the run left; titles and files."""
    from geogs.evaluation import plots
    from geogs.evaluation.shading import viewpoints

    folder = options.output / "report"
    plots.plot_trajectory(folder / "trajectory_truth.png", trajectory)
    plots.plot_error_over_time(folder / "trajectory_error.png", trajectory)
    titles = {
        "trajectory_truth.png": "Trajectory over the truth",
        "trajectory_error.png": "Error over time",
    }
    if surface is not None and meshes is not None:
        mesh, truth = meshes
        camera = read_camera(options.output / "intrinsics.json")
        limit = 2 * surface.scores.threshold_cm
        colours = plots.error_colours(
            mesh.vertices, surface.reconstruction_points, 100 * surface.accuracy, limit
        )
        rows: list[tuple[str, np.ndarray, np.ndarray, np.ndarray | None]] = [
            ("reconstruction", mesh.vertices, mesh.faces, None),
            ("its error", mesh.vertices, mesh.faces, colours),
        ]
        if truth.is_mesh:
            rows.insert(1, ("truth", truth.vertices, truth.faces, None))
        views = viewpoints(mesh.vertices, trajectory.aligned, camera)
        plots.plot_meshes(folder / "mesh_truth.png", rows, views, limit)
        titles["mesh_truth.png"] = "Surface beside the truth"
    titles |= {"keyframes.png": "Rendered keyframes", "mesh.png": "Mesh"}
    return [(title, folder / name) for name, title in titles.items()]
