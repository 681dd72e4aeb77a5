"""The GPU renderer as a differentiable function."""

import torch

from geogs.splat.cuda.passes import backward_pass, forward_pass
from geogs.world.disks import DiskParameters


class RasterizeOnGpu(torch.autograd.Function):
    """Maps of one pose (4, 4), or of several (b, 4, 4) with a leading dimension.

    Depth, normal, alpha, distortion, median depth, visibility.
    """

    @staticmethod
    def forward(ctx, position, quaternion, log_scale, opacity_logit, T_cw, camera, near):  # type: ignore[no-untyped-def]
        disks = DiskParameters(position, quaternion, log_scale, opacity_logit)
        with_trace = any(ctx.needs_input_grad)
        maps, trace = forward_pass(disks, camera, T_cw, near, with_trace)
        if with_trace:
            # Saved, so that PyTorch notices if they are changed before the backward pass.
            ctx.save_for_backward(*disks, T_cw)
            ctx.trace = trace
            ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(maps.median_depth, maps.visible)
        normal = maps.normal.movedim(-3, -1)
        return maps.depth, normal, maps.alpha, maps.distortion, maps.median_depth, maps.visible

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *gradients):  # type: ignore[no-untyped-def]
        *_, T_cw = ctx.saved_tensors
        d_disks, d_T = backward_pass(ctx.trace, gradients[:4], ctx.needs_input_grad[4])
        if d_T is not None:
            d_T = d_T.view(T_cw.shape).to(T_cw)
        return *d_disks, d_T, None, None
