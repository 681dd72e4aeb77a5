"""How far matches contradict a rigid scene, cell by cell, the poses being as they are.

A cell's depth takes up whatever lies along its epipolar lines, so each cell is first given the
depth that suits all of its own matches best; what is left of them no depth explains.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.bundle.projection import INVERSE_DEPTHS, MIN_Z, relative_motion
from geogs.geometry.camera import Camera
from geogs.geometry.least_squares import Policy, Step, minimise
from geogs.geometry.robust import huber_weight

BEHIND = 100.0
"""Residual of a match, in its deviations, whose cell would lie behind the target."""


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
    """Residuals of all matches in their deviations, each cell at the depth that suits it best.

    Args:
        camera: of the frames.
        rays: of the cells.
        T_cw: poses, which stay; float64, on any device.
        inverse_depth: where the search for each cell's depth begins.
        source: frame whose cells an edge matches.
        target: frame in which they are found.
        pixels: position in the target of every cell of the source.
        weight: inverse variance of x and y, 1 / pixel^2; 0 where there is no match.
        huber: standard deviations beyond which a residual counts linearly.
        iterations: damped Gauss-Newton steps.

    Returns 0 where there is no match.
    """
    if not camera.is_pinhole:  # as a pinhole would have seen them
        plane, focal = camera.plane(pixels), pixels.new_tensor([camera.fx, camera.fy])
        pixels = plane * focal + pixels.new_tensor([camera.cx, camera.cy])
    if inverse_depth.is_cuda:
        from geogs.bundle.cuda import rigidity

        T_ji = relative_motion(T_cw, source, target).cpu()
        return rigidity.best_residuals(
            camera, rays, T_ji, inverse_depth, source.cpu(), pixels, weight, huber, iterations,
            INVERSE_DEPTHS, BEHIND,
        )  # fmt: skip
    T_ji = relative_motion(T_cw, source, target).to(inverse_depth)
    source = source.to(inverse_depth.device)
    # Axis by axis, in units of the focal lengths: far faster than pairs of numbers.
    ax, ay, az = (rays @ T_ji[:, :3, :3].mT).permute(2, 0, 1).contiguous()
    tx, ty, tz = T_ji[:, :3, 3].T[..., None]
    wx, wy = weight[..., 0] * camera.fx**2, weight[..., 1] * camera.fy**2
    ux, uy = (pixels[..., 0] - camera.cx) / camera.fx, (pixels[..., 1] - camera.cy) / camera.fy

    def projected(d: Float[Tensor, "n p"]) -> tuple[Tensor, ...]:
        """Where cells are seen, the inverse of z, whether they are in front, and residuals."""
        along = d[source]
        z = az + along * tz
        valid, q = z > MIN_Z, 1 / z.clamp(min=MIN_Z)
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
