"""The two passes of the renderer on a CPU, on tensors, without autograd."""

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.splat.cpu.rasterize import Maps, Trace, rasterize_backward, rasterize_forward
from geogs.world.disks import DiskParameters


def forward_pass(
    disks: DiskParameters,
    camera: Camera,
    T_cw: Float[Tensor, "4 4"],
    near: float,
    threads: int,
    with_trace: bool = True,
) -> tuple[Maps, Trace]:
    """Maps of one pose. Without trace a backward pass is not possible."""
    x, q, scale, logit = (p.detach().contiguous().numpy() for p in disks)
    pose = T_cw.detach()[:3].to("cpu", torch.float64).contiguous().numpy()
    return rasterize_forward((x, q, scale, logit), camera, pose, near, threads, with_trace)


def backward_pass(
    trace: Trace, gradients: tuple[Tensor, ...], threads: int
) -> tuple[DiskParameters, Float[Tensor, "4 4"]]:
    """Gradients of the disks and, float64, of the pose. May be asked for again.

    ``gradients`` are those of depth, normal, alpha and distortion.
    """
    depth, normal, alpha, distortion = (g.to(torch.float32).contiguous().numpy() for g in gradients)
    found = rasterize_backward(trace, depth, normal, alpha, distortion, threads)
    d_T = torch.zeros(4, 4, dtype=torch.float64)
    d_T[:3] = torch.from_numpy(found.T_cw)
    disks = (found.position, found.quaternion, found.log_scale, found.opacity_logit)
    return DiskParameters(*map(torch.from_numpy, disks)), d_T
