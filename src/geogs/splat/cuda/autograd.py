"""The GPU renderer as a differentiable function."""

import functools

import torch
from torch import Tensor

from geogs.gpu.transfer import to_device
from geogs.splat.cuda.pool import RasterizerPool
from geogs.splat.cuda.rasterize import MapGradients, Maps, Views
from geogs.world.disks import DiskParameters


@functools.cache
def _pool() -> RasterizerPool:
    """The process's rasterizers."""
    return RasterizerPool()


class RasterizeOnGpu(torch.autograd.Function):
    """Maps of one pose (4, 4), or of several (b, 4, 4) with a leading dimension.

    Depth, normal, alpha, distortion, median depth, visibility. The compositing is launched on the
    guess that the list entries fit where the last ones did, and once more if they do not: that is
    known as soon as the projection is done, while the GPU goes on.
    """

    @staticmethod
    def forward(ctx, position, quaternion, log_scale, opacity_logit, T_cw, camera, near):  # type: ignore[no-untyped-def]
        device, n = position.device, len(position)
        given = (position, quaternion, log_scale, opacity_logit)
        disks = DiskParameters(*(p.contiguous() for p in given))
        poses = to_device(T_cw, device, torch.float64).contiguous().view(-1, 4, 4)
        views = Views(poses)
        loan = _pool().lend(n, len(poses), camera, near, device)
        rasterizer, maps = loan.rasterizer, Maps.empty(camera, T_cw.shape[:-2], n, device)
        with_trace = any(ctx.needs_input_grad)
        rasterizer.project(disks, views, maps)
        rasterizer.note_projection()
        rasterizer.blend(views, maps, with_trace)
        if not rasterizer.has_room():
            rasterizer.project(disks, views, maps)
            rasterizer.blend(views, maps, with_trace)
        if with_trace:
            # Saved, so that PyTorch notices if they are changed before the backward pass.
            ctx.save_for_backward(*given, T_cw)
            ctx.disks, ctx.views, ctx.loan = disks, views, loan
            ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(maps.median_depth, maps.visible)
        normal = maps.normal.movedim(-3, -1)
        return maps.depth, normal, maps.alpha, maps.distortion, maps.median_depth, maps.visible

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *gradients):  # type: ignore[no-untyped-def]
        *_, T_cw = ctx.saved_tensors
        rasterizer, disks = ctx.loan.rasterizer, ctx.disks
        d_disks = DiskParameters(*(torch.empty_like(p) for p in disks))
        d_T = None
        if ctx.needs_input_grad[4]:
            d_T = torch.empty_like(ctx.views.poses)
        shape = (rasterizer.camera.height, rasterizer.camera.width)
        maps = _map_gradients(gradients[:4], (*T_cw.shape[:-2], *shape))
        rasterizer.backward(disks, ctx.views, maps, d_disks, d_T)
        if d_T is not None:
            d_T = d_T.view(T_cw.shape).to(T_cw)
        return *d_disks, d_T, None, None


def _map_gradients(gradients: tuple[Tensor | None, ...], shape: tuple[int, ...]) -> MapGradients:
    """Contiguous float32 gradients; zeros for those that are missing."""
    known = next(g for g in gradients if g is not None)
    depth, normal, alpha, distortion = gradients
    if normal is None:
        normal, planar = known.new_zeros((3, *shape), dtype=torch.float32), True
    else:
        normal = normal.to(torch.float32)
        planar = normal.movedim(-1, -3).is_contiguous()
        normal = normal.movedim(-1, -3) if planar else normal.contiguous()
    plain = (
        known.new_zeros(shape, dtype=torch.float32)
        if g is None
        else g.to(torch.float32).contiguous()
        for g in (depth, alpha, distortion)
    )
    d_depth, d_alpha, d_distortion = plain
    return MapGradients(d_depth, normal, d_alpha, d_distortion, planar)
