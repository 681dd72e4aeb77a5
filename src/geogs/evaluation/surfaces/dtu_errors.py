"""The DTU benchmark's distances between a mesh and a structured-light scan, in millimetres.

Aanaes et al., "Large-scale data for multiple-view stereopsis", IJCV 2016, in the form of the
Python evaluation that 2DGS and PGSR come with.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from geogs.errors import InputError
from geogs.evaluation.surfaces.surface import Surface, read_surface
from geogs.evaluation.surfaces.surface_errors import SurfaceErrors
from geogs.io.mat_reader import read_mat
from geogs.threads import on_one_torch_thread

SPACING = 0.2
"""Spacing of samples, millimetres."""
MAX_DISTANCE = 20.0
"""Distances from this on are left out, millimetres."""

_BELOW, _ABOVE = 60.0, 120.0


@dataclass(frozen=True)
class DtuReference:
    """Reference data of a scan, in millimetres of its world."""

    points: Float[np.ndarray, "n 3"]
    """Points of the structured-light scanner."""
    observed: Bool[np.ndarray, "x y z"]
    """Voxels observed by the scanner."""
    low: Float[np.ndarray, "3"]
    """Lower corner of the voxels' box."""
    high: Float[np.ndarray, "3"]
    resolution: float
    """Size of a voxel."""
    plane: Float[np.ndarray, "4"]
    """Plane of the table: points above have a positive product with (x, y, z, 1)."""


@dataclass(frozen=True)
class DtuScores:
    """Errors of a mesh; the field's "Chamfer distance" on DTU is ``overall_mm``."""

    d2s_mm: float
    """Data to scan, the accuracy: mean distance of the mesh's points to the scan."""
    s2d_mm: float
    """Scan to data, the completeness: mean distance of the scan's points to the mesh's."""
    overall_mm: float
    """Mean of the two."""
    d2s_median_mm: float
    s2d_median_mm: float
    d2s_left_out: float
    """Percentage of the mesh's points 20 mm or more away, which do not count."""
    s2d_left_out: float
    data_points: int
    """Number of thinned points of the mesh in observed voxels."""
    scan_points: int
    """Number of points of the scan above the table."""
    protocol: str = "DTU (d2s, s2d)"

    @property
    def colour_limit_cm(self) -> float:
        """Largest distance on the colour scale."""
        return 0.2

    def rows(self) -> list[tuple[str, str]]:
        """Rows of a table."""
        return [
            ("d2s, accuracy (mm)", f"{self.d2s_mm:.3f}"),
            ("s2d, completeness (mm)", f"{self.s2d_mm:.3f}"),
            ("overall (mm)", f"{self.overall_mm:.3f}"),
            ("  medians of d2s / s2d (mm)", f"{self.d2s_median_mm:.3f} / {self.s2d_median_mm:.3f}"),
            (
                f"  left out, {MAX_DISTANCE:g} mm or more (%)",
                f"{self.d2s_left_out:.2f} / {self.s2d_left_out:.2f}",
            ),
            ("  points of data / scan", f"{self.data_points} / {self.scan_points}"),
        ]


def read_dtu_reference(folder: str | Path, scan: int) -> DtuReference:
    """Read a scan from the official folder with ``ObsMask/`` and ``Points/stl/``.

    Raises:
        InputError: a file is missing or malformed.
    """
    folder = Path(folder)
    mask_file = folder / "ObsMask" / f"ObsMask{scan}_10.mat"
    mask = _read_mat(mask_file, ("ObsMask", "BB", "Res"))
    plane_file = folder / "ObsMask" / f"Plane{scan}.mat"
    plane = _read_mat(plane_file, ("P",))["P"].astype(np.float64).ravel()
    box = mask["BB"].astype(np.float64)
    if box.shape != (2, 3) or plane.shape != (4,) or mask["ObsMask"].ndim != 3:
        raise InputError(f"{mask_file} or {plane_file.name} is not of the DTU evaluation.")
    points = read_surface(folder / "Points" / "stl" / f"stl{scan:03}_total.ply").vertices
    observed = mask["ObsMask"].astype(bool)
    resolution = float(mask["Res"].ravel()[0])
    return DtuReference(points, observed, box[0], box[1], resolution, plane)


@on_one_torch_thread
def evaluate_dtu(mesh: Surface, reference: DtuReference, seed: int = 0) -> SurfaceErrors[DtuScores]:
    """Compare a mesh, in millimetres and cut by the masks, with a scan.

    The mesh becomes points 0.2 mm apart: its vertices and regular samples of its triangles
    (:func:`dense_points`), shuffled, from which each point kept removes its neighbours
    (:func:`thin`). For d2s those in observed voxels are compared with the nearest point of the
    scan. For s2d the scan's points above the table are compared with the nearest point of the mesh
    in the box of the voxels (60 mm more below, 120 mm above). Distances of 20 mm or more are left
    out of both means.

    Raises:
        InputError: no point of the mesh is in an observed voxel.
    """
    from scipy.spatial import cKDTree

    points = dense_points(mesh, SPACING)
    points = points[np.random.default_rng(seed).permutation(len(points))]
    points = points[thin(points, SPACING)]
    points = points[_in_box(points, reference)]
    data = points[_observed(points, reference)]
    if not len(data):
        raise InputError(
            "No part of the mesh is where the DTU scanner could see; is it in millimetres and in "
            "the world of the scan?"
        )
    above = reference.points @ reference.plane[:3] + reference.plane[3] > 0
    scan = reference.points[above]
    d2s = cKDTree(reference.points).query(data, workers=-1)[0]
    s2d = cKDTree(points).query(scan, workers=-1)[0]
    return SurfaceErrors(_scores(d2s, s2d), data, d2s)


def _scores(d2s: Float[np.ndarray, "n"], s2d: Float[np.ndarray, "m"]) -> DtuScores:
    near = d2s[d2s < MAX_DISTANCE], s2d[s2d < MAX_DISTANCE]
    if not len(near[0]) or not len(near[1]):
        raise InputError(
            f"The mesh and the DTU scan are nowhere nearer than {MAX_DISTANCE:g} mm; is the mesh "
            f"in the world of the scan?"
        )
    accuracy = float(near[0].mean())
    completeness = float(near[1].mean())
    return DtuScores(
        d2s_mm=accuracy,
        s2d_mm=completeness,
        overall_mm=(accuracy + completeness) / 2,
        d2s_median_mm=float(np.median(near[0])),
        s2d_median_mm=float(np.median(near[1])),
        d2s_left_out=100 * (1 - len(near[0]) / len(d2s)),
        s2d_left_out=100 * (1 - len(near[1]) / len(s2d)),
        data_points=len(d2s),
        scan_points=len(s2d),
    )


def _in_box(points: Float[np.ndarray, "n 3"], r: DtuReference) -> Bool[np.ndarray, "n"]:
    return np.asarray(((points >= r.low - _BELOW) & (points < r.high + _ABOVE)).all(1))


def _observed(points: Float[np.ndarray, "n 3"], r: DtuReference) -> Bool[np.ndarray, "n"]:
    cell = np.rint((points - r.low) / r.resolution).astype(np.int64)
    inside = ((cell >= 0) & (cell < r.observed.shape)).all(1)
    result = np.zeros(len(points), bool)
    result[inside] = r.observed[tuple(cell[inside].T)]
    return result


def _read_mat(path: Path, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    if not path.is_file():
        raise InputError(f"{path} does not exist; give the folder of the official DTU evaluation.")
    content = read_mat(path, names)
    if any(name not in content for name in names):
        raise InputError(f"{path} lacks {', '.join(names)}, which DTU's files hold.")
    return content


def thin(points: Float[np.ndarray, "n 3"], radius: float) -> Bool[np.ndarray, "n"]:
    """Greedy thinning: each point kept, in order, removes all later ones at most ``radius`` away.

    A removed point removes none. Takes time proportional to the number of points.
    """
    from geogs.evaluation.surfaces.surface_kernels import thin_in_order

    kept = np.zeros(len(points), bool)
    # Centred, so that cell numbers stay small in any frame.
    centred = points - points.mean(0) if len(points) else points
    thin_in_order(np.ascontiguousarray(centred, np.float64), radius, kept)
    return kept


def dense_points(mesh: Surface, spacing: float) -> Float[np.ndarray, "n 3"]:
    """All vertices, then a regular grid of points inside every triangle.

    With edges u and v from the first corner the grid has floor(|u| / s) by floor(|v| / s) cells,
    s being ``spacing`` times sqrt(|u| |v| / |u x v|), so that a cell's area is about the squared
    spacing; the points are the centres of the cells, where they are in the triangle. Source: the
    Python version of DTU's evaluation that comes with 2DGS.
    """
    from geogs.evaluation.surfaces.surface_kernels import grid_samples

    vertices = np.ascontiguousarray(mesh.vertices, np.float64)
    faces = np.ascontiguousarray(mesh.faces, np.int64)
    count = grid_samples(vertices, faces, spacing, np.empty((0, 3)))
    samples = np.empty((count, 3))
    grid_samples(vertices, faces, spacing, samples)
    return np.concatenate([vertices, samples])
