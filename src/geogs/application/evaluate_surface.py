"""Comparison of surfaces in an evaluation, by the chosen protocol."""

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from geogs.application.result_settings import EvalSettings
from geogs.errors import InputError
from geogs.evaluation.surfaces.photoconsistency import PhotoScores, evaluate_photoconsistency
from geogs.evaluation.surfaces.silhouettes import Silhouette, cull_by_masks, mesh_silhouettes
from geogs.evaluation.surfaces.surface import Surface, read_surface
from geogs.evaluation.surfaces.surface_errors import SurfaceComparison, SurfaceErrors, SurfaceScores
from geogs.evaluation.surfaces.visibility import Visibility, cull_mesh
from geogs.evaluation.true_scene import TrueScene, silhouettes
from geogs.geometry.camera import Camera
from geogs.io.writers.intrinsics_file import read_camera

_MASK_EDGE, _PHOTO_EDGE = 1600, 800
_MILLIMETRES = 1000.0
_REACH = 0.003


def compare_surface(
    settings: EvalSettings,
    scene: TrueScene,
    mesh: Surface,
    mesh_file: Path | None,
    points_file: Path | None,
) -> SurfaceComparison | None:
    """Compare a mesh in metres with the truth; none where there is no true surface."""
    if settings.protocol == "dtu":
        return _dtu(settings, scene, mesh)
    if mesh_file is None:
        return None
    truth = read_surface(mesh_file)
    points = None if points_file is None else read_surface(points_file)
    match settings.protocol:
        case "object":
            return _object(settings, scene, mesh, truth, points)
        case "area":
            return _area(settings, scene, mesh, truth, points)
        case _:
            return _toolbox(settings, scene, mesh, truth)


def photoconsistency(settings: EvalSettings, scene: TrueScene, mesh: Surface) -> PhotoScores:
    """Photo-consistency of every ``photo_every``-th image with others on a mesh in metres."""
    source = scene.images(_PHOTO_EDGE)
    views = list(source)
    held_out = range(settings.photo_every // 2, len(views), settings.photo_every)
    there = Surface(mesh.vertices / scene.metres, mesh.faces)
    return evaluate_photoconsistency(there, source.camera, views, held_out or range(len(views)))


def _area(
    settings: EvalSettings, scene: TrueScene, mesh: Surface, truth: Surface, points: Surface | None
) -> SurfaceComparison:
    from geogs.evaluation.surfaces.reconstruction_errors import evaluate_reconstruction

    visibility = None
    if settings.cull:
        visibility = Visibility(_occluder(truth), *_views(settings, scene))
    errors = evaluate_reconstruction(
        mesh,
        truth,
        points,
        visibility,
        cull_reconstruction=settings.cull,
        use_icp=settings.icp,
        threshold=settings.threshold or 0.05,
        samples=settings.samples or 200_000,
        seed=settings.seed,
    )
    return _comparison(errors, mesh, truth)


def _toolbox(
    settings: EvalSettings, scene: TrueScene, mesh: Surface, truth: Surface
) -> SurfaceComparison:
    """The scripts' own measures; NICE-SLAM's culls both meshes, Splat-SLAM's the truth alone."""
    from geogs.evaluation.surfaces.toolbox import evaluate_samples, evaluate_vertices

    threshold = settings.threshold or 0.05
    if settings.cull:
        camera, T_cw = _views(settings, scene)
        occluder = _occluder(truth)
        truth = cull_mesh(truth, camera, T_cw, settings.cull_rule)
        if settings.protocol == "samples":
            mesh = cull_mesh(mesh, camera, T_cw, settings.cull_rule, occluder)
    if settings.protocol == "vertex":
        errors = evaluate_vertices(mesh, truth, threshold=threshold, seed=settings.seed)
    else:
        samples = settings.samples or 200_000
        errors = evaluate_samples(
            mesh, truth, threshold=threshold, samples=samples, seed=settings.seed
        )
    return _comparison(errors, mesh, truth)


def _object(
    settings: EvalSettings, scene: TrueScene, mesh: Surface, truth: Surface, points: Surface | None
) -> SurfaceComparison:
    from geogs.evaluation.surfaces.object_errors import evaluate_object

    errors = evaluate_object(
        mesh,
        _occluder(truth),
        _object_masks(settings, scene, truth),
        points,
        threshold=settings.threshold or 0.001,
        samples=settings.samples or 4_000_000,
        seed=settings.seed,
    )
    points_in = errors.reconstruction_points
    distance = errors.accuracy
    return SurfaceComparison(errors.scores, mesh, truth, points_in, distance, _REACH)


def _dtu(settings: EvalSettings, scene: TrueScene, mesh: Surface) -> SurfaceComparison:
    from geogs.evaluation.surfaces.dtu_errors import evaluate_dtu, read_dtu_reference

    if settings.dtu_data is None:
        raise InputError("The DTU protocol needs --dtu-data, the folder with ObsMask and Points.")
    reference = read_dtu_reference(settings.dtu_data, _scan_number(settings))
    source = scene.images(_MASK_EDGE)
    if source.scene_scale != "millimetres":
        raise InputError(f"{scene.path} is no DTU scan in millimetres; give one with cameras.npz.")
    cut = Surface(mesh.vertices * _MILLIMETRES, mesh.faces)
    masks = silhouettes(source)
    if masks is not None:
        cut = cull_by_masks(cut, [mask.dilated() for mask in masks])
    errors = evaluate_dtu(cut, reference, settings.seed)
    return SurfaceComparison(
        errors.scores,
        Surface(cut.vertices / _MILLIMETRES, cut.faces),
        None,
        errors.reconstruction_points / _MILLIMETRES,
        errors.accuracy / _MILLIMETRES,
        _REACH,
    )


def _object_masks(settings: EvalSettings, scene: TrueScene, truth: Surface) -> list[Silhouette]:
    """Widened masks in metres: the data set's own, else the silhouettes of the true mesh."""
    if not scene.path.is_dir():
        camera = read_camera(settings.output / "intrinsics.json").with_long_edge(_MASK_EDGE)
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


def _scan_number(settings: EvalSettings) -> int:
    if settings.dtu_scan is not None:
        return settings.dtu_scan
    found = re.search(r"scan_?(\d+)", settings.gt.resolve().name)
    if found is None:
        raise InputError(f"{settings.gt} is not named like scan24; give the number by --dtu-scan.")
    return int(found[1])


def _views(settings: EvalSettings, scene: TrueScene) -> tuple[Camera, Float[np.ndarray, "v 4 4"]]:
    camera = read_camera(settings.output / "intrinsics.json")
    return camera, np.linalg.inv(scene.trajectory.T_wc[:: settings.cull_every])


def _occluder(truth: Surface) -> Surface:
    if not truth.is_mesh:
        raise InputError("The true surface has no triangles, which this comparison needs.")
    return truth


def _comparison(
    errors: SurfaceErrors[SurfaceScores], mesh: Surface, truth: Surface
) -> SurfaceComparison:
    return SurfaceComparison(
        errors.scores, mesh, truth, errors.reconstruction_points, errors.accuracy
    )
