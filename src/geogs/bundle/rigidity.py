"""Residuals of matches that contradict a rigid scene, cell by cell, at given poses.

A cell's depth absorbs errors along its epipolar lines. So each cell first gets the depth that fits
all of its own matches best; no depth explains the remaining residuals.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.bundle.projection import INVERSE_DEPTHS, MIN_Z, relative_motion
from geogs.geometry.camera import Camera
from geogs.geometry.least_squares import Policy, Step, minimise
from geogs.geometry.robust import huber_weight

BEHIND = 100.0
"""Residual, in deviations, of a match whose cell would be behind the target."""


def best_residuals(
    camera: Camera,
    rays: Float[Tensor, "p 3"],
    T_cw: Float[Tensor, "n 4 4"],
    inverse_depth: Float[Tensor, "n p"],
    source: Int[Tensor, "e"],
    target: Int[Tensor, "e"],
    pixels: Float[Tensor, "e p 2"],
    weight: Float[Tensor, "e p 2"],
    huber: float = 0.5,
    iterations: int = 3,
) -> Float[Tensor, "e p"]:
    """Compute residuals of all matches in their deviations, each cell at its best depth.

    Args:
        camera: of the frames.
        rays: of the cells.
        T_cw: poses, fixed; float64, on any device.
        inverse_depth: initial depth of each cell.
        source: frame of the matched cells of an edge.
        target: frame of their matches.
        pixels: position in the target of every cell of the source.
        weight: inverse variance of x and y, 1 / pixel^2; 0 where there is no match.
        huber: Huber threshold in standard deviations.
        iterations: damped Gauss-Newton steps.

    Returns 0 where there is no match.
    """
    pixels = camera.as_pinhole(pixels)
    if inverse_depth.is_cuda:
        from geogs.bundle.cuda import rigidity

        T_ji = relative_motion(T_cw, source, target).cpu()
        return rigidity.best_residuals(
            camera, rays, T_ji, inverse_depth, source.cpu(), pixels, weight, huber, iterations,
            INVERSE_DEPTHS, BEHIND,
        )  # fmt: skip
    T_ji = relative_motion(T_cw, source, target).to(inverse_depth)
    source = source.to(inverse_depth.device)
    # Axis by axis, in units of the focal lengths: far faster than on pairs of numbers.
    ax, ay, az = (rays @ T_ji[:, :3, :3].mT).permute(2, 0, 1).contiguous()
    tx, ty, tz = T_ji[:, :3, 3].T[..., None]
    wx, wy = weight[..., 0] * camera.fx**2, weight[..., 1] * camera.fy**2
    ux, uy = (pixels[..., 0] - camera.cx) / camera.fx, (pixels[..., 1] - camera.cy) / camera.fy

    def projected(d: Float[Tensor, "n p"]) -> tuple[Tensor, ...]:
        """Return projections of cells, 1 / z, whether they are in front, and residuals."""
        along = d[source]
        z = az + along * tz
        valid = z > MIN_Z
        q = 1 / z.clamp(min=MIN_Z)
        x, y = (ax + along * tx) * q, (ay + along * ty) * q
        rx, ry = ux - x, uy - y
        return x, y, q, valid, rx, ry, (wx * rx * rx + wy * ry * ry).sqrt()

    def linearised(d: Float[Tensor, "n p"]) -> tuple[Tensor, Tensor]:
        x, y, q, valid, rx, ry, norm = projected(d)
        jx, jy = (tx - tz * x) * q, (ty - tz * y) * q
        robust = valid * huber_weight(norm, huber)
        gx, gy = wx * jx * robust, wy * jy * robust
        curvature = torch.zeros_like(d).index_add_(0, source, gx * jx + gy * jy)
        return curvature, torch.zeros_like(d).index_add_(0, source, gx * rx + gy * ry)

    def step(
        d: Float[Tensor, "n p"], linear: tuple[Tensor, Tensor], damping: float
    ) -> Step[Tensor]:
        curvature, gradient = linear
        raised = damping * curvature.mean(1, keepdim=True) + 1e-8
        return Step((d + gradient / (curvature + raised)).clamp(*INVERSE_DEPTHS))

    d = minimise(inverse_depth, linearised, step, Policy(iterations, damping=1e-3)).state
    *_, valid, _, _, norm = projected(d)
    return torch.where(valid | (wx == 0), norm, BEHIND)
