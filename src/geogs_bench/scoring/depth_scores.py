"""Depth of a result's mesh against the true one in views of its sequence, by kind of region.

The mesh is rendered from the estimated poses, with one scale for the whole sequence, so that errors
of the trajectory, which other benchmarks measure, do not shift its edges.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32

from geogs.errors import InputError
from geogs.evaluation.surfaces.raster import render_mesh
from geogs.geometry.camera import Camera
from geogs_bench.data.benchmark_scene import BenchmarkScene
from geogs_bench.results.record import PLACES, Place, PlaceScore
from geogs_bench.results.result_folder import ResultFolder
from geogs_bench.scoring.places import places_of
from geogs_bench.scoring.plane_fits import fit_planes
from geogs_bench.scoring.true_depths import TrueView, pose_at, read_true_depths

VIEWS = 25
"""Approximate number of compared frames."""
NEAR, FAR = 0.02, 0.05
"""Relative errors of the two ratios."""
_EXACT_WINDOW, _SENSOR_WINDOW = 7, 21
"""Sides of the planes whose normals are compared, pixels."""
_EXACT_TOLERANCE, _SENSOR_TOLERANCE = 0.003, 0.006
"""Largest RMS residual of these planes, as a fraction of the depth."""


@dataclass(frozen=True)
class ComparedView:
    """A view with its true depth, the estimated depth, and the kinds of its regions."""

    view: TrueView
    found: Float32[np.ndarray, "h w"]
    """Estimated z in metres; infinite where the mesh has a hole."""
    places: dict[Place, Bool[np.ndarray, "h w"]]
    angle: Float32[np.ndarray, "h w"]
    """Angle between the normals, degrees; NaN where either is unknown."""


def score_depth(
    scene: BenchmarkScene, result: ResultFolder
) -> tuple[tuple[PlaceScore, ...], list[ComparedView]]:
    """The scores of every kind of region that occurs, and the compared views.

    Raises:
        InputError: the result has no mesh or no poses, or the sequence no true depth.
    """
    mesh, poses = result.mesh(), result.poses()
    if mesh is None or not mesh.is_mesh or poses is None:
        raise InputError(f"{result.path} holds no mesh with a trajectory to score.")
    poses = poses.of("tracked")
    camera = result.camera
    truth = read_true_depths(scene, result, poses, VIEWS)
    depths = [
        render_mesh(mesh.vertices, mesh.faces, camera, np.linalg.inv(pose_at(poses, v.timestamp)))
        for v in truth.views
    ]
    found = one_scale([view.depth for view in truth.views], [depth for depth, _ in depths])
    window = _EXACT_WINDOW if truth.is_exact else _SENSOR_WINDOW
    tolerance = _EXACT_TOLERANCE if truth.is_exact else _SENSOR_TOLERANCE
    views = [
        compare_view(view, depth, (truth.camera, camera), window, tolerance)
        for view, depth in zip(truth.views, found, strict=True)
    ]
    return place_scores(views), views


def one_scale(
    true: Sequence[Float[np.ndarray, "h w"]], found: Sequence[Float[np.ndarray, "h w"]]
) -> list[Float32[np.ndarray, "h w"]]:
    """Scale the estimated depths to metres, by the median of true over estimated in all views.

    Raises:
        InputError: there is no pixel where both are known.
    """
    ratios = []
    for z, own in zip(true, found, strict=True):
        both = (z > 0) & np.isfinite(z) & np.isfinite(own)
        ratios.append(z[both] / own[both])
    every = np.concatenate(ratios) if ratios else np.zeros(0)
    if not len(every):
        raise InputError("The mesh is in no view where the true depth is known.")
    scale = float(np.median(every))
    return [(scale * own).astype(np.float32) for own in found]


def compare_view(
    view: TrueView,
    found: Float32[np.ndarray, "h w"],
    cameras: tuple[Camera, Camera],
    window: int,
    tolerance: float,
) -> ComparedView:
    """The kinds of a view's regions, and the error of its normals where they are known.

    ``cameras`` are the true one and the result's, of the same pixels. Both normals are of planes of
    ``window`` x ``window`` pixels; the true plane has to fit to ``tolerance``, the estimated one
    need not.
    """
    true_fits, own_fits = (fit_planes(depth, window, tolerance) for depth in (view.depth, found))
    cosine = (true_fits.normals(cameras[0]) * own_fits.normals(cameras[1])).sum(-1)
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    angle = np.where(true_fits.is_good & own_fits.is_known, angle, np.nan).astype(np.float32)
    places = places_of(view.depth, view.image, cameras[0], true_fits)
    return ComparedView(view, found, places, angle)


def place_scores(views: Sequence[ComparedView]) -> tuple[PlaceScore, ...]:
    """The scores of each kind of region over all views; kinds that no view has are left out."""
    true, found, angle = (
        np.concatenate([a.ravel() for a in arrays])
        for arrays in (
            [v.view.depth for v in views], [v.found for v in views], [v.angle for v in views],
        )
    )  # fmt: skip
    judged = int((true > 0).sum())
    scores = []
    for place in PLACES:
        mask = np.concatenate([v.places[place].ravel() for v in views])
        if mask.any():
            scores.append(_score(place, true[mask], found[mask], angle[mask], judged))
    return tuple(scores)


def _score(
    place: Place,
    true: Float32[np.ndarray, "n"],
    found: Float32[np.ndarray, "n"],
    angle: Float32[np.ndarray, "n"],
    judged: int,
) -> PlaceScore:
    share, covered = 100 * len(true) / judged, np.isfinite(found)
    if place == "sky":
        return PlaceScore(place, share, 100 * float(covered.mean()))
    error = found / true - 1  # infinite where there is a hole
    known = angle[np.isfinite(angle)]
    return PlaceScore(
        place,
        share,
        100 * float(covered.mean()),
        100 * float(np.median(np.abs(error[covered]))) if covered.any() else None,
        100 * float((np.abs(error) <= NEAR).mean()),
        100 * float((np.abs(error) <= FAR).mean()),
        100 * float((error < -FAR).mean()),
        100 * float((covered & (error > FAR)).mean()),
        float(np.median(known)) if len(known) else None,
    )
