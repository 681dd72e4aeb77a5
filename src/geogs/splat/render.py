"""Rendering the map: one contract, several backends."""

from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.geometry.given_pose import GivenPose
from geogs.splat.protocols import Forward
from geogs.splat.reference import render_reference
from geogs.types import MapSnapshot
from geogs.world.disks import DiskParameters, GaussianMap

Backend = Literal["auto", "reference", "cpu", "cuda"]

NEAR = 0.05
"""Depth in map units up to which a disk's centre and hits are ignored."""


@dataclass(frozen=True, slots=True)
class RenderOutput:
    """Maps of one view, or of several with a leading dimension.

    Gradients flow from all but ``median_depth`` and ``visible``.
    """

    depth: Float[Tensor, "*b h w"]
    """Ray-disk intersections blended and divided by alpha, z in map units; 0 where alpha is 0."""
    normal: Float[Tensor, "*b h w 3"]
    """Sum of weight times unit normal, camera frame, facing the camera; its length is at most
    alpha."""
    alpha: Float[Tensor, "*b h w"]
    """Sum of the blending weights, in [0, 1)."""
    distortion: Float[Tensor, "*b h w"]
    """2 sum_i w_i |z_i A_i - Z_i| with A_i, Z_i the sums of w_j, w_j z_j in front of i: the paper's
    sum_ij w_i w_j |z_i - z_j| where hits are sorted along the ray, never negative elsewhere."""
    median_depth: Float[Tensor, "*b h w"]
    """z of the last disk blended while more than half of the light is left; 0 where there is
    none. No gradient."""
    visible: Bool[Tensor, "n"]
    """Disks blended into at least one pixel of any view."""

    def shown_depth(self, min_alpha: float) -> Float[Tensor, "*b h w"]:
        """Depth where the map is opaque enough to hide what lies behind, else 0."""
        return torch.where(self.alpha.detach() > min_alpha, self.depth, 0.0)


def render(
    disks: GaussianMap | DiskParameters | MapSnapshot,
    camera: Camera,
    T_cw: GivenPose,
    backend: Backend = "auto",
    near: float = NEAR,
) -> RenderOutput:
    """Render depth, normals, opacity and distortion of the disks as seen from ``T_cw``.

    Differentiable in the ten numbers of every disk and in the entries of ``T_cw``. Disks may be
    those of a map in training, before activation, or as ``load_map`` gives them.

    Blending follows 2-D Gaussian splatting (Huang et al. 2024): front to back in the order of
    centre depths, weight w_i = a_i T_i with a_i = min(o_i exp(-rho_i / 2), 0.99), hits below 1/255
    skipped, stopping before the disk that would leave less than 1e-4 of the light. rho is the
    smaller of the squared distance on the disk (in deviations) and twice the squared pixel distance
    from the projected centre.

    ``reference`` works in the positions' dtype on any device, ``cpu`` in float32 on the CPU and
    ``cuda`` in float32 on the GPU that holds the disks; ``auto`` takes the fastest that can.
    """
    parameters = parameters_of(disks)
    T_cw, backend = torch.as_tensor(T_cw), chosen_backend(parameters, backend)
    if backend == "reference":
        return RenderOutput(*render_reference(parameters, camera, T_cw, near))
    return RenderOutput(*Rasterized.apply(backend, camera, near, T_cw, *parameters))


def parameters_of(disks: GaussianMap | DiskParameters | MapSnapshot) -> DiskParameters:
    """The numbers that are rendered."""
    if isinstance(disks, MapSnapshot):
        return DiskParameters.of(disks)
    return disks.parameters if isinstance(disks, GaussianMap) else disks


def chosen_backend(disks: DiskParameters, backend: Backend) -> Literal["reference", "cpu", "cuda"]:
    """The backend that renders the disks. Raises ValueError if the requested one cannot."""
    if backend == "auto":
        position = disks.position
        fits = position.dtype == torch.float32 and position.device.type in ("cpu", "cuda")
        backend = "reference" if not fits else "cuda" if position.is_cuda else "cpu"
    if backend != "reference" and any(p.dtype != torch.float32 for p in disks):
        raise ValueError(f"The {backend} backend renders float32 disks.")
    if backend == "cpu" and any(p.device.type != "cpu" for p in disks):
        raise ValueError("The cpu backend renders disks on the CPU.")
    return backend


def passes_of(backend: Literal["cpu", "cuda"]) -> Forward:
    """The compiled passes of a backend."""
    if backend == "cuda":
        from geogs.splat.cuda import passes as on_gpu

        return on_gpu.rendered
    from geogs.splat.cpu import passes as on_cpu

    return on_cpu.rendered


class Rasterized(torch.autograd.Function):
    """A compiled backend; on a GPU of one pose (4, 4), or of several (b, 4, 4)."""

    @staticmethod
    def forward(
        ctx: Any,
        backend: Literal["cpu", "cuda"],
        camera: Camera,
        near: float,
        T_cw: Tensor,
        *parameters: Tensor,
    ) -> tuple[Tensor, ...]:
        disks, with_trace = DiskParameters(*parameters), any(ctx.needs_input_grad)
        maps, back = passes_of(backend)(disks, camera, T_cw, near, with_trace)
        if with_trace:
            # Saved, so that PyTorch notices if they are changed before the backward pass.
            ctx.save_for_backward(*parameters, T_cw)
            ctx.back = back
            ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(*maps[4:])
        return maps

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        *_, T_cw = ctx.saved_tensors
        d_disks, d_T = ctx.back(gradients[:4], ctx.needs_input_grad[3])
        return None, None, None, None if d_T is None else d_T.view(T_cw.shape).to(T_cw), *d_disks
