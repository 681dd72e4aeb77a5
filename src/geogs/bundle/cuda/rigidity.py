"""Residuals of matches at given poses that no depth explains, on the GPU: one launch."""

from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.bundle.cuda.linear_edges import LAUNCH_BOUND, block_size, edges_by_frame
from geogs.geometry.camera import Camera
from geogs.gpu.kernels import kernels_for
from geogs.gpu.transfer import to_device

SOURCE = Path(__file__).with_name("rigidity.cu")


def best_residuals(
    camera: Camera,
    rays: Float[Tensor, "p 3"],
    T_ji: Float[Tensor, "e 4 4"],
    inverse_depth: Float[Tensor, "n p"],
    source: Int[Tensor, "e"],
    pixels: Float[Tensor, "e p 2"],
    weight: Float[Tensor, "e p 2"],
    huber: float,
    iterations: int,
    between: tuple[float, float],
    behind: float,
) -> Float[Tensor, "e p"]:
    """Do :func:`geogs.bundle.rigidity.best_residuals`, given the motions along edges.

    These and ``source`` are on the CPU, all else on the GPU, where nothing waits.
    """
    device = inverse_depth.device
    (frames, cells) = inverse_depth.shape
    first, order = edges_by_frame(source, frames, device)
    motions = to_device(T_ji[:, :3].reshape(-1), device, torch.float32)
    depth = inverse_depth.clone(memory_format=torch.contiguous_format)
    scratch = depth.new_empty(2 * depth.numel())
    residual = depth.new_empty(len(source), cells)
    kernels_for(SOURCE, device)["best_residuals"](
        frames, block_size(cells, LAUNCH_BOUND), first, order, motions, rays, pixels.contiguous(),
        weight.contiguous(), cells, camera.fx, camera.fy, camera.cx, camera.cy, huber, iterations,
        *between, behind, depth, scratch, residual,
    )  # fmt: skip
    return residual
