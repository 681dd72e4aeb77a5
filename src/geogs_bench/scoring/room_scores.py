"""Scores of a mesh in metres against the true surface of a room."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64

from geogs.evaluation.surfaces.reconstruction_errors import (
    ReconstructionScores,
    evaluate_reconstruction,
)
from geogs.evaluation.surfaces.surface import Surface, read_surface
from geogs.evaluation.surfaces.surface_errors import SurfaceComparison
from geogs.evaluation.surfaces.toolbox import evaluate_vertices
from geogs.evaluation.surfaces.visibility import cull_mesh
from geogs.geometry.camera import Camera
from geogs_bench.data.benchmark_scene import Truth
from geogs_bench.results.record import SurfaceScore

_CULLING_POSES = 200
"""Approximate number of true poses that determine what the camera saw."""
_LONGEST_EDGE = 0.05
"""Longest edge of a true mesh in metres; coarser ones are cut into smaller triangles."""
_MOST_FACES = 4_000_000


@dataclass(frozen=True)
class TrueSurface:
    """The true surface for the comparison with a mesh."""

    whole: Surface
    """The whole surface, for accuracy."""
    seen: Surface
    """The part that the camera saw, for comparisons of whole meshes."""
    points: Surface | None
    """Points that the camera saw, for completeness; none if ``seen`` is used."""


def read_true_surface(
    truth: Truth, camera: Camera, T_cw: Float64[np.ndarray, "n 4 4"]
) -> TrueSurface | None:
    """Read the surface of a scene, culled to the part seen from the true poses (world to camera).

    None if the scene has no surface. Raises InputError if it cannot be read or none was seen.
    """
    if truth.surface is None:
        return None
    whole = read_surface(truth.surface)
    points = None if truth.points is None else read_surface(truth.points)
    if truth.culling == "done" or not whole.is_mesh:
        return TrueSurface(whole, whole, points)
    views = T_cw[:: max(1, len(T_cw) // _CULLING_POSES)]
    # Culling tests vertices, and a wall of two triangles has hardly any.
    fine = with_short_edges(whole, _LONGEST_EDGE)
    seen = cull_mesh(fine, camera, views, truth.culling, whole)
    return TrueSurface(whole, seen, points)


def score_surface(
    mesh: Surface, truth: TrueSurface, use_icp: bool, seed: int
) -> tuple[tuple[SurfaceScore, ...], SurfaceComparison]:
    """Vertex-weighted and, last, area-weighted scores in cm, and the errors over the mesh.

    ``use_icp`` first aligns the mesh rigidly by ICP (0.1 m), as the scripts of the SLAM tables do.
    A truth without triangles has no vertex-weighted score.
    """
    area = evaluate_reconstruction(
        mesh, truth.whole, truth.points or truth.seen, use_icp=use_icp, seed=seed
    )
    scores = [in_cm("area", area.scores)]
    if truth.seen.is_mesh:
        vertices = evaluate_vertices(mesh, truth.seen, use_icp, seed=seed)
        scores.insert(0, in_cm("vertices", vertices.scores))
    points = area.reconstruction_points
    distance = area.accuracy
    return tuple(scores), SurfaceComparison(area.scores, mesh, truth.whole, points, distance)


def in_cm(weighting: Literal["area", "vertices"], scores: ReconstructionScores) -> SurfaceScore:
    """Convert scores to a record in cm."""
    return SurfaceScore(
        weighting=weighting,
        unit="cm",
        accuracy=scores.accuracy_cm,
        completeness=scores.completeness_cm,
        chamfer=scores.chamfer_cm,
        ratio=scores.completeness_ratio,
        precision=scores.precision_ratio,
        f_score=scores.f_score,
        threshold=scores.threshold_cm,
        accuracy_median=scores.accuracy_median_cm,
        completeness_median=scores.completeness_median_cm,
    )


def with_short_edges(mesh: Surface, longest: float) -> Surface:
    """Halve triangles across their longest edge until no edge is too long.

    Halving keeps thin triangles few. Neighbours that are halved across their common edge share
    the new corner; a neighbour that is not keeps that edge whole.
    """
    vertices = mesh.vertices
    faces = mesh.faces.astype(np.int64)
    while True:
        corners = vertices[faces]
        lengths = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=-1)
        long = np.flatnonzero(lengths.max(1) > longest)
        if not len(long) or len(faces) + len(long) > _MOST_FACES:
            return Surface(vertices, faces)
        # Rotate the corners of each triangle so that its longest edge is the one from a to b.
        order = lengths[long].argmax(1)[:, None] + np.arange(3)
        a, b, c = np.take_along_axis(faces[long], order % 3, axis=1).T
        key = np.minimum(a, b) * len(vertices) + np.maximum(a, b)
        _, first, middle = np.unique(key, return_index=True, return_inverse=True)
        middle = middle.reshape(-1) + len(vertices)
        vertices = np.concatenate([vertices, (vertices[a[first]] + vertices[b[first]]) / 2])
        faces[long] = np.stack([a, middle, c], 1)
        faces = np.concatenate([faces, np.stack([middle, b, c], 1)])
