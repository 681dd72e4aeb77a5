"""The GPU renderer as a differentiable function."""

import torch
from torch import Tensor

from geogs.splat.cuda.rasterize import MapGradients, Trace, rasterize_backward, rasterize_forward
from geogs.splat.map import DiskParameters


class RasterizeOnGpu(torch.autograd.Function):
    """Maps of one pose (4, 4), or of several (b, 4, 4) with a leading dimension.

    Depth, normal, alpha, distortion, median depth, visibility.
    """

    @staticmethod
    def forward(ctx, position, quaternion, log_scale, opacity_logit, T_cw, camera, near):  # type: ignore[no-untyped-def]
        disks = DiskParameters(position, quaternion, log_scale, opacity_logit)
        plain = DiskParameters(*(p.detach().contiguous() for p in disks))
        poses = _poses(T_cw, position.device)
        with_trace = any(ctx.needs_input_grad)
        maps, trace = rasterize_forward(plain, camera, poses, near, with_trace)
        outputs = [maps.depth, maps.normal.permute(0, 2, 3, 1), maps.alpha, maps.distortion]
        outputs.append(maps.median_depth)
        if T_cw.dim() == 2:
            outputs = [o.squeeze(0) for o in outputs]
        if with_trace:
            # Saved, so that PyTorch notices if they are changed before the backward pass.
            ctx.save_for_backward(*disks, T_cw)
            ctx.trace = trace
            ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(outputs[4], maps.visible)
        return *outputs, maps.visible

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *gradients):  # type: ignore[no-untyped-def]
        *_, T_cw = ctx.saved_tensors
        trace: Trace = ctx.trace
        maps = _map_gradients(gradients[:4], trace.rasterizer.maps.depth.shape)
        result = rasterize_backward(trace, maps, ctx.needs_input_grad[4])
        d_T = None
        if result.poses is not None:
            d_T = torch.zeros(len(result.poses), 4, 4, dtype=T_cw.dtype, device=T_cw.device)
            d_T[:, :3] = result.poses
            d_T = d_T.reshape(T_cw.shape)
        return *result.parameters, d_T, None, None


def _poses(T_cw: Tensor, device: torch.device) -> Tensor:
    """(b, 3, 4) float64 on the device."""
    upper = T_cw.detach()[..., :3, :].to(device, torch.float64)
    return upper.reshape(-1, 3, 4).contiguous()


def _map_gradients(gradients: tuple[Tensor | None, ...], shape: torch.Size) -> MapGradients:
    """Contiguous float32 gradients of (b, h, w) maps; zeros for those that are missing."""
    known = next(g for g in gradients if g is not None)
    zeros = None
    if any(g is None for g in gradients):
        zeros = known.new_zeros((3, *shape), dtype=torch.float32)
    depth, alpha, distortion = (
        zeros[0] if g is None else g.to(torch.float32).reshape(shape).contiguous()  # type: ignore[index]
        for g in (gradients[0], gradients[2], gradients[3])
    )
    normal = zeros if gradients[1] is None else gradients[1].to(torch.float32)
    assert normal is not None
    if gradients[1] is None:
        normal = normal.view(shape[0], 3, *shape[1:])
    else:
        normal = normal.reshape(*shape, 3)
        planar = normal.permute(0, 3, 1, 2)
        normal = planar if planar.is_contiguous() else normal.contiguous()
    return MapGradients(depth, normal, alpha, distortion)
