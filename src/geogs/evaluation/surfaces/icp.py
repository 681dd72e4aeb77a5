"""Iterative closest points: final rigid alignment of a reconstruction to the truth."""

import numpy as np
import torch
from jaxtyping import Float

from geogs.evaluation.surfaces.surface_distance import SurfaceDistance
from geogs.geometry.lie import se3_exp
from geogs.geometry.umeyama import umeyama

_REACH, _ITERATIONS, _TOLERANCE = 0.1, 30, 1e-6


def icp(points: Float[np.ndarray, "n 3"], target: SurfaceDistance) -> Float[np.ndarray, "4 4"]:
    """Rigid motion of ``points`` onto ``target`` from the identity.

    Partners are the nearest surface points within 0.1 m. Distances along the normals
    are minimised for a mesh (point to plane, Chen and Medioni 1992), those between the points for
    a point set (Besl and McKay 1992). Stops when the fraction of the points that have a partner and
    the RMSE change by less than 1e-6 relatively. With fewer than six partners the identity is
    returned.
    """
    T = np.eye(4)
    fitness = 0.0
    rmse = 0.0
    for _ in range(_ITERATIONS):
        moved = points @ T[:3, :3].T + T[:3, 3]
        distance, closest, normal = target.nearest(moved)
        near = distance < _REACH
        if near.sum() < 6:
            return np.eye(4)
        previous = fitness, rmse
        fitness = float(near.mean())
        rmse = float(np.sqrt((distance[near] ** 2).mean()))
        change = max(abs(fitness - previous[0]), abs(rmse - previous[1]) / max(rmse, 1e-12))
        if change < _TOLERANCE:
            return T
        normals = None if normal is None else normal[near]
        T = _step(moved[near], closest[near], normals) @ T
    return T


def icp_points(
    source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, "4 4"]:
    """Rigid motion of points onto points from the identity, with Open3D's rules.

    Partners are the nearest target points nearer than 0.1 m; the squared distances
    between them are minimised (Besl and McKay 1992). Stops when fitness and RMSE both change by
    less than 1e-6; the change of the RMSE counts in the unit of the points, although
    Open3D (``registration_icp``, whose defaults these are) calls it relative. With fewer than
    three partners the motion so far is returned.
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(target)
    T = np.eye(4)
    moved = source
    previous = (np.inf, np.inf)
    for step in range(_ITERATIONS + 1):
        distance, index = tree.query(moved, distance_upper_bound=_REACH, workers=-1)
        near = np.isfinite(distance)
        fitness = float(near.mean())
        rmse = float(np.sqrt((distance[near] ** 2).mean())) if near.any() else 0.0
        converged = max(abs(fitness - previous[0]), abs(rmse - previous[1])) < _TOLERANCE
        if converged or near.sum() < 3 or step == _ITERATIONS:
            break
        previous = fitness, rmse
        T = _step(moved[near], target[index[near]], None) @ T
        moved = source @ T[:3, :3].T + T[:3, 3]
    return T


def _step(
    source: Float[np.ndarray, "k 3"],
    target: Float[np.ndarray, "k 3"],
    normals: Float[np.ndarray, "k 3"] | None,
) -> Float[np.ndarray, "4 4"]:
    if normals is None:
        _, R, t = umeyama(torch.from_numpy(source), torch.from_numpy(target), with_scale=False)
        T = np.eye(4)
        T[:3, :3] = R.numpy()
        T[:3, 3] = t.numpy()
        return T
    centre = source.mean(0)
    jacobian = np.concatenate([normals, np.cross(source - centre, normals)], 1)
    residual = ((target - source) * normals).sum(1)
    hessian = jacobian.T @ jacobian
    # Directions not determined by any normal (sliding along one plane) do not change.
    xi = np.linalg.pinv(hessian, rcond=1e-6, hermitian=True) @ (jacobian.T @ residual)
    T = se3_exp(torch.from_numpy(xi)).numpy()
    to_centre = np.eye(4)
    to_centre[:3, 3] = centre
    return to_centre @ T @ np.linalg.inv(to_centre)
