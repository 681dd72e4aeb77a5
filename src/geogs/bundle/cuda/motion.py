"""Poses of frames against fixed keyframes on the GPU: one launch for all iterations."""

from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.gpu.kernels import kernels_for
from geogs.gpu.transfer import to_device
from geogs.keyframes.grid import SampleGrid

SOURCE = Path(__file__).with_name("motion.cu")


def _threads(cells: int) -> int:
    return max(64, min(-(-cells // 32) * 32, 512))


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
    """Motion-only adjustment as ``geogs.bundle.motion.solve_poses``.

    Poses and ``frame`` may be on the CPU; poses are returned where they were given.
    """
    n, device, frame = len(T_cw), inverse_depth.device, frame.cpu()
    order = torch.argsort(frame, stable=True)
    first = torch.searchsorted(frame[order], torch.arange(n + 1))
    rows = to_device(torch.cat([first, order]).int(), device)
    poses = to_device(torch.cat([T_cw, T_source]), device)
    residual = torch.empty_like(pixels, memory_format=torch.contiguous_format)
    cells = inverse_depth.shape[1]
    kernels_for(SOURCE, device)["solve_poses"](
        n, _threads(cells), rows[: n + 1], rows[n + 1 :], inverse_depth.contiguous(), poses[n:],
        pixels.contiguous(), weight.contiguous(), None, rays.contiguous(), cells, camera.fx,
        camera.fy, camera.cx, camera.cy, iterations, huber, poses, residual,
    )  # fmt: skip
    return poses[:n].to(T_cw.device), residual


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
    """As :func:`geogs.bundle.motion.fit_frame`; what it returns stays on the device."""
    device, c, threads = inverse_depth.device, grid.camera, _threads(grid.size)
    state = torch.cat([T_guess.reshape(-1), T_guess.new_zeros(4), T_keyframe.reshape(-1)])
    state = to_device(state, device)
    rows = torch.arange(2, dtype=torch.int32, device=device)
    residual, pixels, weight = (
        torch.empty_like(grid.pixels),
        pixels.contiguous(),
        weight.contiguous(),
    )
    kernels = kernels_for(SOURCE, device)
    kernels["solve_poses"](
        1, threads, rows, rows, inverse_depth, state[20:], pixels, weight, information, grid.rays,
        grid.size, c.fx, c.fy, c.cx, c.cy, iterations, huber, state, residual,
    )  # fmt: skip
    kernels["judge_match"](
        1, threads, pixels, weight, information, residual, grid.pixels, grid.size, limit,
        state[16:], shared=4 * grid.size,
    )  # fmt: skip
    return state[:16].reshape(4, 4), state[16:20]
