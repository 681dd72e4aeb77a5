"""Motion-only adjustment on the CPU: poses of frames seen from keyframes that stay fixed."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.bundle.linearise import normal_equations, weighed_residuals
from geogs.bundle.projection import linearise, project
from geogs.geometry.camera import Camera
from geogs.geometry.lie import move, se3_inverse


def solve_poses(
    camera: Camera,
    rays: Float[Tensor, "p 3"],
    T_cw: Float[Tensor, "n 4 4"],
    inverse_depth: Float[Tensor, "e p"],
    T_source: Float[Tensor, "e 4 4"],
    frame: Int[Tensor, "e"],
    pixels: Float[Tensor, "e p 2"],
    weight: Float[Tensor, "e p 2"],
    iterations: int = 4,
    huber: float = 3.0,
) -> tuple[Float[Tensor, "n 4 4"], Float[Tensor, "e p 2"]]:
    """Motion-only adjustment of independent frames, each seen from keyframes that stay fixed.

    Edge e observes frame ``frame[e]`` from a keyframe at ``T_source[e]`` with the given inverse
    depth. Returns the poses and the residuals of the observations at those poses.
    """
    if inverse_depth.is_cuda:
        from geogs.bundle.cuda import motion

        return motion.solve_poses(
            camera, rays, T_cw, inverse_depth, T_source, frame, pixels, weight, iterations, huber
        )
    T = T_cw
    inverse = se3_inverse(T_source)
    for _ in range(iterations):
        p = linearise(camera, rays, T[frame] @ inverse, inverse_depth)
        r, w = weighed_residuals(p, pixels, weight, huber)
        wJ = p.pose_jacobian * w.mT[:, None]
        H = torch.zeros(len(T), 6, 6, dtype=torch.float64, device=T.device)
        g = torch.zeros(len(T), 6, dtype=torch.float64, device=T.device)
        edge_H, edge_g = normal_equations(wJ, p.pose_jacobian, r)
        H.index_add_(0, frame, edge_H)
        g.index_add_(0, frame, edge_g)
        damping = 1e-4 * H.diagonal(dim1=-2, dim2=-1) + 1e-6
        xi = torch.linalg.solve(H + torch.diag_embed(damping), g)
        T = move(xi.nan_to_num(0.0, 0.0, 0.0), T)
    final = project(camera, rays, T[frame] @ inverse, inverse_depth)
    return T, pixels - final.pixels
