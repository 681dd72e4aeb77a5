"""How far matches contradict a rigid scene, cell by cell, the poses being as they are.

A cell's depth takes up whatever lies along its epipolar lines, so each cell is first given the
depth that suits all of its own matches best; what is left of them no depth explains.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.bundle.projection import relative_motion, seen_from_targets
from geogs.geometry.camera import Camera

BEHIND = 100.0
"""Residual of a match, in its deviations, whose cell would lie behind the target."""
DEPTH_RANGE = 1e-3, 1e2
"""Least and largest inverse depth of a cell, per map unit."""


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
    iterations: int = 4,
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
    T_ji = relative_motion(T_cw, source, target).to(inverse_depth)
    source, t = source.to(inverse_depth.device), T_ji[:, None, :3, 3]
    f, c = pixels.new_tensor([camera.fx, camera.fy]), pixels.new_tensor([camera.cx, camera.cy])
    d = inverse_depth
    for n in range(iterations + 1):
        y, valid, z = seen_from_targets(rays, T_ji, d[source])
        q = 1 / z[..., None]
        at = y[..., :2] * q
        r = pixels - (f * at + c)
        norm = (weight * r.square()).sum(-1).sqrt()
        norm = torch.where(valid | (weight[..., 0] == 0), norm, BEHIND)
        if n == iterations:
            break
        J = f * (t[..., :2] - t[..., 2:] * at) * q
        wJ = weight * J * (valid * huber / norm.clamp(min=huber))[..., None]
        curvature = torch.zeros_like(d).index_add_(0, source, (wJ * J).sum(-1))
        gradient = torch.zeros_like(d).index_add_(0, source, (wJ * r).sum(-1))
        damping = 1e-3 * curvature.mean(1, keepdim=True) + 1e-8
        d = (d + gradient / (curvature + damping)).clamp(*DEPTH_RANGE)
    return norm
