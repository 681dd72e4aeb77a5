"""Motion-only adjustment on the CPU: poses of frames seen from keyframes that stay fixed."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.bundle.linearise import normal_equations, weighed_residuals
from geogs.bundle.projection import linearise, project
from geogs.geometry.camera import Camera
from geogs.geometry.lie import move, se3_inverse
from geogs.keyframes.grid import SampleGrid


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


def fit_frame(
    grid: SampleGrid,
    T_guess: Float[Tensor, "4 4"],
    T_keyframe: Float[Tensor, "4 4"],
    inverse_depth: Float[Tensor, "p"],
    information: Float[Tensor, "p"],
    pixels: Float[Tensor, "p 2"],
    weight: Float[Tensor, "p 2"],
    iterations: int,
    huber: float,
    limit: float,
) -> tuple[Float[Tensor, "4 4"], Float[Tensor, "4"]]:
    """Pose of a frame against one keyframe, and what tells whether it is right.

    Cells without information do not count. Returns the pose; the share of the cells that are
    matched, the share whose residual is below ``limit`` pixels, and the medians over the matched
    of the residual and of the motion, in pixels: not numbers where nothing is matched. On a GPU
    all stays there, and nothing waits.
    """
    if grid.on_gpu:
        from geogs.bundle.cuda import motion

        return motion.fit_frame(
            grid, T_guess, T_keyframe, inverse_depth, information, pixels, weight, iterations,
            huber, limit,
        )  # fmt: skip
    weight = weight * (information > 0)[:, None]
    used = weight[:, 0] > 0
    T, residual = solve_poses(
        grid.camera,
        grid.rays,
        T_guess[None],
        inverse_depth[None],
        T_keyframe[None],
        torch.zeros(1, dtype=torch.long, device=weight.device),
        pixels[None],
        weight[None],
        iterations=iterations,
        huber=huber,
    )
    error, flow = residual[0].norm(dim=-1), (pixels - grid.pixels).norm(dim=-1)
    agree = used & (error < limit)
    shares = (used.float().mean(), agree.float().mean())
    return T[0], torch.stack([*shares, error[used].median(), flow[used].median()])
