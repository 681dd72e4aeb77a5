"""The two passes of the renderer on a CPU, on tensors, without autograd."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.splat.cpu.rasterize import rasterize_backward, rasterize_forward
from geogs.splat.protocols import Backward
from geogs.threads import worker_count
from geogs.world.disks import DiskParameters


def rendered(
    disks: DiskParameters,
    camera: Camera,
    T_cw: Float[Tensor, "4 4"],
    near: float,
    with_trace: bool,
) -> tuple[tuple[Tensor, ...], Backward]:
    """Maps of one pose, as in ``RenderOutput``, and their backward pass.

    The backward pass takes the gradients of depth, normal, alpha and distortion, None for zero, and
    returns those of the disks and, float64, of the pose. It may be called again, not without trace.
    """
    x, q, scale, logit = (p.detach().contiguous().numpy() for p in disks)
    pose, threads = T_cw.detach()[:3].to("cpu", torch.float64).contiguous().numpy(), worker_count()
    maps, trace = rasterize_forward((x, q, scale, logit), camera, pose, near, threads, with_trace)
    shown = tuple(map(torch.from_numpy, maps))
    shapes = [m.shape for m in shown[:4]]  # not the maps, which belong to the graph

    def back(
        gradients: Sequence[Tensor | None], with_pose: bool
    ) -> tuple[DiskParameters, Float[Tensor, "4 4"]]:
        depth, normal, alpha, distortion = (
            (torch.zeros(shape) if g is None else g).to(torch.float32).contiguous().numpy()
            for g, shape in zip(gradients, shapes, strict=True)
        )
        d_disks, rows = rasterize_backward(trace, depth, normal, alpha, distortion, threads)
        d_T = torch.zeros(4, 4, dtype=torch.float64)
        d_T[:3] = torch.from_numpy(rows)
        return DiskParameters(*map(torch.from_numpy, d_disks)), d_T

    return shown, back
