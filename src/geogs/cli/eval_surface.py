"""The part of ``geogs eval`` that compares surfaces, by the protocol that was asked for."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from geogs.errors import InputError
from geogs.evaluation.culling import cull_mesh
from geogs.evaluation.masks import Silhouette, cull_by_masks, mesh_silhouettes
from geogs.evaluation.photoconsistency import PhotoScores, evaluate_photoconsistency
from geogs.evaluation.scores import SurfaceScores
from geogs.evaluation.surface import Surface, read_surface
from geogs.evaluation.truth import TrueScene, photographs, silhouettes
from geogs.evaluation.visibility import Visibility
from geogs.geometry.camera import Camera
from geogs.io.writers.intrinsics import read_camera

if TYPE_CHECKING:
    from geogs.cli.eval import EvalOptions
    from geogs.evaluation.reconstruction import SurfaceErrors

_MASK_EDGE, _PHOTO_EDGE = 1600, 800
_MILLIMETRES = 1000.0
_REACH = 0.003


@dataclass(frozen=True)
class SurfaceComparison:
    """Scores, and what pictures of the errors need (metres, frame of the truth)."""

    scores: SurfaceScores
    mesh: Surface
    truth: Surface
    points: Float[np.ndarray, "n 3"]
    """Of the reconstruction, where it was compared."""
    distance: Float[np.ndarray, "n"]
    """To the truth; inf where it did not count."""
    reach: float = np.inf
    """How far from the points the mesh was still compared; beyond, pictures show no error."""


def compare_surface(
    options: "EvalOptions",
    scene: TrueScene,
    mesh: Surface,
    mesh_file: Path | None,
    points_file: Path | None,
) -> SurfaceComparison | None:
    """Compare a mesh in metres with the truth; none where there is no true surface."""
    if options.protocol == "dtu":
        return _dtu(options, scene, mesh)
    if mesh_file is None:
        return None
    truth = read_surface(mesh_file)
    points = None if points_file is None else read_surface(points_file)
    match options.protocol:
        case "object":
            return _object(options, scene, mesh, truth, points)
        case "area":
            return _area(options, scene, mesh, truth, points)
        case _:
            return _toolbox(options, scene, mesh, truth)


def photoconsistency(options: "EvalOptions", scene: TrueScene, mesh: Surface) -> PhotoScores:
    """How well every so many images agree with others on a mesh in metres."""
    source = scene.images(_PHOTO_EDGE)
    views = photographs(source)
    held_out = range(options.photo_every // 2, len(views), options.photo_every)
    there = Surface(mesh.vertices / scene.metres, mesh.faces)
    return evaluate_photoconsistency(there, source.camera, views, held_out or range(len(views)))


def _area(
    options: "EvalOptions", scene: TrueScene, mesh: Surface, truth: Surface, points: Surface | None
) -> SurfaceComparison:
    from geogs.evaluation.reconstruction import evaluate_reconstruction

    visibility = None
    if options.cull:
        visibility = Visibility(_occluder(truth), *_views(options, scene))
    errors = evaluate_reconstruction(
        mesh,
        truth,
        points,
        visibility,
        cull_reconstruction=options.cull,
        use_icp=options.icp,
        threshold=options.threshold or 0.05,
        samples=options.samples or 200_000,
        seed=options.seed,
    )
    return _comparison(errors, mesh, truth)


def _toolbox(
    options: "EvalOptions", scene: TrueScene, mesh: Surface, truth: Surface
) -> SurfaceComparison:
    """The scripts' own measures; NICE-SLAM's culls both meshes, Splat-SLAM's the truth alone."""
    from geogs.evaluation.toolbox import evaluate_samples, evaluate_vertices

    threshold = options.threshold or 0.05
    if options.cull:
        camera, T_cw = _views(options, scene)
        occluder = _occluder(truth)
        truth = cull_mesh(truth, camera, T_cw, options.cull_rule)
        if options.protocol == "samples":
            mesh = cull_mesh(mesh, camera, T_cw, options.cull_rule, occluder)
    if options.protocol == "vertex":
        errors = evaluate_vertices(mesh, truth, threshold=threshold, seed=options.seed)
    else:
        samples = options.samples or 200_000
        errors = evaluate_samples(
            mesh, truth, threshold=threshold, samples=samples, seed=options.seed
        )
    return _comparison(errors, mesh, truth)


def _object(
    options: "EvalOptions", scene: TrueScene, mesh: Surface, truth: Surface, points: Surface | None
) -> SurfaceComparison:
    from geogs.evaluation.object import evaluate_object

    errors = evaluate_object(
        mesh,
        _occluder(truth),
        _object_masks(options, scene, truth),
        points,
        threshold=options.threshold or 0.001,
        samples=options.samples or 4_000_000,
        seed=options.seed,
    )
    points_in, distance = errors.reconstruction_points, errors.accuracy
    return SurfaceComparison(errors.scores, mesh, truth, points_in, distance, _REACH)


def _dtu(options: "EvalOptions", scene: TrueScene, mesh: Surface) -> SurfaceComparison:
    from geogs.evaluation.dtu import evaluate_dtu, read_dtu_reference

    if options.dtu_data is None:
        raise InputError("The DTU protocol needs --dtu-data, the folder with ObsMask and Points.")
    reference = read_dtu_reference(options.dtu_data, _scan_number(options))
    source = scene.images(_MASK_EDGE)
    if source.scene_scale != "millimetres":
        raise InputError(f"{scene.path} is no DTU scan in millimetres; give one with cameras.npz.")
    cut = Surface(mesh.vertices * _MILLIMETRES, mesh.faces)
    masks = silhouettes(source)
    if masks is not None:
        cut = cull_by_masks(cut, [mask.dilated() for mask in masks])
    errors = evaluate_dtu(cut, reference, options.seed)
    scan = Surface(reference.points / _MILLIMETRES, np.zeros((0, 3), np.int64))
    return SurfaceComparison(
        errors.scores,
        Surface(cut.vertices / _MILLIMETRES, cut.faces),
        scan,
        errors.data / _MILLIMETRES,
        errors.d2s / _MILLIMETRES,
        _REACH,
    )


def _object_masks(options: "EvalOptions", scene: TrueScene, truth: Surface) -> list[Silhouette]:
    """Widened masks in metres: the data set's own, else the silhouettes of the true mesh."""
    if not scene.path.is_dir():
        camera = read_camera(options.output / "intrinsics.json").with_long_edge(_MASK_EDGE)
        views = mesh_silhouettes(truth, camera, np.linalg.inv(scene.trajectory.T_wc))
        return [view.dilated() for view in views]
    source = scene.images(_MASK_EDGE)
    T_cw = source.T_cw.copy()
    T_cw[:, :3, 3] *= scene.metres
    masks = silhouettes(source)
    if masks is None:
        return [view.dilated() for view in mesh_silhouettes(truth, source.camera, T_cw)]
    return [
        Silhouette(mask.mask, mask.camera, T).dilated() for mask, T in zip(masks, T_cw, strict=True)
    ]


def _scan_number(options: "EvalOptions") -> int:
    if options.dtu_scan is not None:
        return options.dtu_scan
    found = re.search(r"scan_?(\d+)", options.gt.resolve().name)
    if found is None:
        raise InputError(f"{options.gt} is not named like scan24; give the number by --dtu-scan.")
    return int(found[1])


def _views(options: "EvalOptions", scene: TrueScene) -> tuple[Camera, Float[np.ndarray, "v 4 4"]]:
    camera = read_camera(options.output / "intrinsics.json")
    return camera, np.linalg.inv(scene.trajectory.T_wc[:: options.cull_every])


def _occluder(truth: Surface) -> Surface:
    if not truth.is_mesh:
        raise InputError("The true surface has no triangles, which this comparison needs.")
    return truth


def _comparison(errors: "SurfaceErrors", mesh: Surface, truth: Surface) -> SurfaceComparison:
    return SurfaceComparison(
        errors.scores, mesh, truth, errors.reconstruction_points, errors.accuracy
    )
