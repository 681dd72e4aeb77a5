"""Reconstruction errors exactly as in the scripts behind published tables.

Both measures first move the reconstruction by point-to-point ICP of its vertices (0.1 m), and
take unsquared distances between points. They differ in the points. Prefer the measure of
reconstruction_errors, which depends on neither tessellation nor sampling.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from geogs.errors import InputError
from geogs.evaluation.surfaces.icp import icp_points
from geogs.evaluation.surfaces.reconstruction_errors import ReconstructionScores, surface_scores
from geogs.evaluation.surfaces.surface import Surface, sample_surface
from geogs.evaluation.surfaces.surface_errors import SurfaceErrors
from geogs.threads import on_one_torch_thread

VERTEX_WEIGHTED = "vertex-weighted (Splat-SLAM toolbox)"
AREA_WEIGHTED = "area-weighted (NICE-SLAM), distances to samples"


@on_one_torch_thread
def evaluate_vertices(
    reconstruction: Surface,
    truth: Surface,
    use_icp: bool = True,
    threshold: float = 0.05,
    seed: int = 0,
) -> SurfaceErrors[ReconstructionScores]:
    """Vertex-weighted errors of a mesh in metres, in the frame of the true mesh.

    Accuracy is the mean over the vertices of the reconstruction, completeness over those of the
    truth, so finely tessellated parts count more. The mesh with more vertices determines the number
    of points of the other: if that is the reconstruction, its vertices are compared with as many
    samples of the truth, and the vertices of the truth with those of the reconstruction.
    Otherwise its vertices are compared with those of the truth, and the truth's with as many
    samples of the reconstruction as the truth has vertices. Samples are independent and uniform by
    area; vertices at one position count once, and those without a triangle not at all.

    Source: evaluate_3d_reconstruction_lib as Splat-SLAM and HI-SLAM2 call it. Its tables come from
    the distances of the vertices, which replace those of the samples before the means are taken.

    Raises:
        InputError: one of the two is no mesh or has no area.
    """
    _require_meshes(reconstruction, truth)
    rng = np.random.default_rng(seed)
    truth = _without_duplicates(truth)
    reconstruction, shift = _registered(_without_duplicates(reconstruction), truth, use_icp)
    vertices = reconstruction.vertices
    true_vertices = truth.vertices
    if len(true_vertices) < len(vertices):
        true_targets = sample_surface(truth, len(vertices), rng, stratified=False)[0]
        targets = vertices
    else:
        true_targets = true_vertices
        targets = sample_surface(reconstruction, len(true_vertices), rng, stratified=False)[0]
    return _errors(
        vertices, true_targets, true_vertices, targets, threshold, shift, VERTEX_WEIGHTED
    )


@on_one_torch_thread
def evaluate_samples(
    reconstruction: Surface,
    truth: Surface,
    use_icp: bool = True,
    threshold: float = 0.05,
    samples: int = 200_000,
    seed: int = 0,
) -> SurfaceErrors[ReconstructionScores]:
    """Area-weighted errors of a mesh in metres, in the frame of the true mesh.

    ``samples`` independent points, uniform by area, are drawn on each mesh; accuracy is the mean
    distance of those of the reconstruction to those of the truth, completeness the converse. Even
    equal surfaces are about half the samples' spacing apart: above 1 cm in a furnished room.

    Source: the reconstruction script of NICE-SLAM, which follows iMAP.

    Raises:
        InputError: one of the two is no mesh or has no area.
    """
    _require_meshes(reconstruction, truth)
    rng = np.random.default_rng(seed)
    reconstruction, shift = _registered(reconstruction, truth, use_icp)
    points = sample_surface(reconstruction, samples, rng, stratified=False)[0]
    true_points = sample_surface(truth, samples, rng, stratified=False)[0]
    return _errors(points, true_points, true_points, points, threshold, shift, AREA_WEIGHTED)


def _require_meshes(reconstruction: Surface, truth: Surface) -> None:
    for name, surface in (("reconstruction", reconstruction), ("truth", truth)):
        if not surface.is_mesh or not surface.areas.sum() > 0:
            raise InputError(f"The {name} has no triangles with an area, as this protocol needs.")


def _without_duplicates(surface: Surface) -> Surface:
    """Merge vertices at one position, and drop those without a triangle, like trimesh."""
    surface = surface.part(np.ones(len(surface.faces), bool))
    grid = np.rint(surface.vertices / 1e-8).astype(np.int64)
    first, number = np.unique(grid, axis=0, return_index=True, return_inverse=True)[1:]
    return Surface(surface.vertices[first], number.reshape(-1)[surface.faces])


def _registered(surface: Surface, truth: Surface, use_icp: bool) -> tuple[Surface, float]:
    """The surface after ICP of its vertices, and their mean motion."""
    if not use_icp:
        return surface, 0.0
    moved = surface.transformed(icp_points(surface.vertices, truth.vertices))
    return moved, float(np.linalg.norm(moved.vertices - surface.vertices, axis=1).mean())


def _errors(
    points: Float[np.ndarray, "n 3"],
    true_targets: Float[np.ndarray, "k 3"],
    true_points: Float[np.ndarray, "m 3"],
    targets: Float[np.ndarray, "l 3"],
    threshold: float,
    shift: float,
    protocol: str,
) -> SurfaceErrors[ReconstructionScores]:
    from scipy.spatial import cKDTree

    accuracy = cKDTree(true_targets).query(points, workers=-1)[0]
    completeness = cKDTree(targets).query(true_points, workers=-1)[0]
    scores = surface_scores(accuracy, completeness, threshold, shift)
    return SurfaceErrors(replace(scores, protocol=protocol), points, accuracy)
