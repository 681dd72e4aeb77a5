"""Rotation of the camera between two views, and a test for translation.

Two models explain a flow: the camera only rotated, or it also translated. The second always fits
better, having more parameters; the choice is made by Torr's geometric robust information criterion
(GRIC, 1998), with the operator's own deviations.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from geogs.geometry.nearest_rotation import nearest_rotation
from geogs.tracking.matching.two_view import as_pinhole, rays_through, relative_pose
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid

AGREEING = 0.4
"""Fraction of the matched cells that must agree with a rotation for it to be accepted."""
SHARPENED = (0.1, 0.1, 0.03, 0.03, 0.01, 0.01, 0.005, 0.005, 0.005, 0.005)
"""Scales of the robust loss, step by step, as fractions of the long edge."""
TOLERANCE = 0.008
"""Largest residual of a cell that agrees with a rotation, as a fraction of the long edge."""
MOST_CELLS = 1024
"""Most cells that are fitted, evenly spread."""
MIN_SIGMA = 0.1
"""Least deviation of a cell, pixels."""
LEAST_DEVIATION = 2e-4
"""Least deviation of a rotation, radians, as errors of its many cells are correlated."""


@dataclass(frozen=True)
class RotationFit:
    """Rotation that most of a flow agrees with."""

    R: Float64[Tensor, "3 3"]
    """First camera to second."""
    agreeing: float
    """Fraction of the matched cells within ``TOLERANCE``."""
    deviation: float
    """Standard deviation of the angle, radians."""
    squares: Float64[np.ndarray, "n"]
    """Squared error of each matched cell in the flow's variances."""


@dataclass(frozen=True)
class TwoViewRotation:
    """Rotation of a view relative to another."""

    R: Float64[Tensor, "3 3"]
    """First camera to second."""
    deviation: float
    """Standard deviation of the angle, radians."""
    is_pure: bool
    """Whether the motion is explained by a rotation alone."""


def two_view_rotation(grid: SampleGrid, match: FlowMatch) -> TwoViewRotation | None:
    """Estimate the rotation between two views by the model that fits their flow (one edge) better.

    None where too few cells agree with either. Only confident cells count.
    """
    pair = match.on_cpu().only_sure()
    rotated = fit_rotation(grid, pair)
    if rotated is None:
        return None
    moved = relative_pose(grid.camera, pair)
    if moved is not None:
        T_ji = torch.from_numpy(moved[0])
        if has_moved(grid, pair, rotated, T_ji):
            return TwoViewRotation(T_ji[:3, :3], rotated.deviation, False)
    if rotated.agreeing < AGREEING:
        return None
    return TwoViewRotation(rotated.R, rotated.deviation, True)


def has_moved(
    grid: SampleGrid, match: FlowMatch, rotated: RotationFit, T_ji: Float[Tensor, "4 4"]
) -> bool:
    """Whether a flow (one edge, on the CPU) supports a relative pose rather than a rotation alone.

    ``rotated`` is the rotation that fits it best.
    """
    off = epipolar_squares(grid, match, T_ji)
    return gric(rotated.squares, 2, 3) > gric(off, 3, 5)


def gric(squares: Float64[np.ndarray, "n"], dimension: int, parameters: int) -> float:
    """Return Torr's criterion of a model of two views; the smaller, the better the model.

    Args:
        squares: squared errors of the matches in their variances.
        dimension: of the manifold of matches in the space of four coordinates: 2 where the model
            predicts a point, 3 where it only predicts a line.
        parameters: number of the model's parameters.
    """
    n = len(squares)
    codimension = 4 - dimension
    robust = float(np.minimum(squares, 2 * codimension).sum())
    return robust + dimension * n * math.log(4) + parameters * math.log(4 * max(n, 1))


def fit_rotation(grid: SampleGrid, match: FlowMatch) -> RotationFit | None:
    """Fit the rotation that most of a flow (one edge) agrees with.

    Gauss-Newton on the distances in the second image under Geman and McClure's loss, whose scale
    shrinks from step to step. None where fewer than eight cells are matched.
    """
    camera = grid.camera
    match = as_pinhole(camera, match)
    used = (match.weight[0, :, 0] > 0).cpu().numpy()
    if used.sum() < 8:
        return None
    rays = grid.rays.double().cpu().numpy()[used]
    pixels = match.pixels[0].double().cpu().numpy()[used]
    weight = match.weight[0].double().cpu().numpy()[used]
    weight = weight / (1 + MIN_SIGMA**2 * weight)
    edge = camera.long_edge
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    seen = rays_through(pixels, camera.matrix().numpy())
    first, second = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (rays, seen))
    R = nearest_rotation(second.T @ first)
    some = slice(None, None, -(-len(pixels) // MOST_CELLS))
    damping = 1e-9 * np.eye(3)
    H = np.zeros((3, 3))
    for reach in SHARPENED:
        error, J = _linearised(rays[some] @ R.T, pixels[some], focal, centre)
        square = (error**2).sum(1, keepdims=True) / (reach * edge) ** 2
        robust = weight[some] / (1 + square) ** 2
        weighted = (robust[..., None] * J).reshape(-1, 3).T
        H = weighted @ J.reshape(-1, 3)
        R = _exponential(np.linalg.solve(H + damping, weighted @ error.reshape(-1))) @ R
    error, _ = _linearised(rays @ R.T, pixels, focal, centre)
    agreeing = float((np.linalg.norm(error, axis=1) < TOLERANCE * edge).mean())
    H *= len(pixels) / len(pixels[some])
    deviation = max(math.sqrt(np.trace(np.linalg.inv(H + damping))), LEAST_DEVIATION)
    return RotationFit(torch.from_numpy(R), agreeing, deviation, (weight * error**2).sum(1))


def epipolar_squares(
    grid: SampleGrid, match: FlowMatch, T_ji: Float[Tensor, "4 4"]
) -> Float64[np.ndarray, "n"]:
    """Return squared epipolar distances of the matched cells, in the flow's variances."""
    camera = grid.camera
    match = as_pinhole(camera, match)
    used = match.weight[0, :, 0] > 0
    t = T_ji[:3, 3].double().numpy()
    R = T_ji[:3, :3].double().numpy()
    rotated = grid.rays.cpu().double().numpy()[used.numpy()] @ R.T
    normal = np.cross(t, rotated)  # of the epipolar plane
    line = normal[:, :2] / [camera.fx, camera.fy]
    pixels = match.pixels[0][used].double().numpy() - [camera.cx, camera.cy]
    off = (line * pixels).sum(1) + normal[:, 2]
    weight = match.weight[0][used].double().numpy()
    variance = (line**2 * (1 / weight + MIN_SIGMA**2)).sum(1)
    squares: Float64[np.ndarray, "n"] = off**2 / np.maximum(variance, 1e-30)
    return squares


def _linearised(
    points: Float64[np.ndarray, "n 3"],
    pixels: Float64[np.ndarray, "n 2"],
    focal: Float64[np.ndarray, "2"],
    centre: Float64[np.ndarray, "2"],
) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, "n 2 3"]]:
    """Return residuals of projections, and their derivatives by a rotation on the left."""
    z = np.maximum(points[:, 2], 1e-3)
    x, y = points[:, 0] / z, points[:, 1] / z
    J = np.stack([np.stack([-x * y, 1 + x * x, -y], -1), np.stack([-1 - y * y, x * y, x], -1)], 1)
    return pixels - (focal * np.stack([x, y], -1) + centre), J * focal[:, None]


def _exponential(phi: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """Return the rotation of a rotation vector (Rodrigues)."""
    angle = float(np.linalg.norm(phi))
    K = np.array([[0, -phi[2], phi[1]], [phi[2], 0, -phi[0]], [-phi[1], phi[0], 0]])
    half = np.sinc(angle / (2 * np.pi))
    R: Float64[np.ndarray, "3 3"] = np.eye(3) + np.sinc(angle / np.pi) * K + 0.5 * half**2 * K @ K
    return R
