"""Rendering the map: one contract, several backends."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from geogs.config.arguments import checks_arguments
from geogs.geometry.camera import Camera
from geogs.geometry.given_pose import GivenPose
from geogs.splat.protocols import Forward
from geogs.splat.reference import render_reference
from geogs.types import MapSnapshot
from geogs.world.disks import DiskParameters, GaussianMap

Backend = Literal["auto", "reference", "cpu", "cuda"]

NEAR = 0.05
"""Depth in map units up to which a disk's centre and hits are ignored."""
_Gradients = tuple[Tensor | None, Tensor | None, Tensor | None, Tensor | None]


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


@checks_arguments
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
    T_cw = torch.as_tensor(T_cw)
    backend = chosen_backend(parameters, backend)
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
        from geogs.splat.cuda import rasterize as on_gpu

        return on_gpu.rendered
    from geogs.splat.cpu import rasterize as on_cpu

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
        disks = DiskParameters(*parameters)
        with_trace = any(ctx.needs_input_grad)
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


@dataclass(frozen=True, slots=True)
class RenderGradients:
    """Gradients of a loss of one rendering, on the disks' device."""

    disks: DiskParameters
    """Gradients of every disk's parameters, before activation; zero for disks not visible."""
    T_cw: Float64[Tensor, "4 4"]
    """Gradients of the entries of the pose; the last row is zero."""


@dataclass(frozen=True, slots=True)
class PullBack:
    """Takes gradients with respect to the maps of a rendering back to disks and pose.

    It is linear, and may be called again. It keeps the data of the rendering as long as it exists;
    disks and pose must not be changed in place before the last call. On a GPU it is called in the
    stream of the rendering.
    """

    _backward: Callable[[_Gradients], RenderGradients]
    _shape: tuple[int, int]

    def __call__(
        self,
        depth: Float[Tensor, "h w"] | None = None,
        normal: Float[Tensor, "h w 3"] | None = None,
        alpha: Float[Tensor, "h w"] | None = None,
        distortion: Float[Tensor, "h w"] | None = None,
    ) -> RenderGradients:
        """Gradients of a loss, given its gradients by the maps (zero for those left out).

        Raises ValueError if none is given, or one does not have its map's shape.
        """
        given = {"depth": depth, "normal": normal, "alpha": alpha, "distortion": distortion}
        if all(g is None for g in given.values()):
            raise ValueError("The gradient of a loss by at least one of the maps is needed.")
        for name, g in given.items():
            expected = (*self._shape, 3) if name == "normal" else self._shape
            if g is not None and g.shape != expected:
                shape = "x".join(map(str, g.shape))
                raise ValueError(
                    f"The gradient by {name} is {shape}, the map {'x'.join(map(str, expected))}."
                )
        with torch.no_grad():
            return self._backward((depth, normal, alpha, distortion))


@checks_arguments
def render_vjp(
    disks: GaussianMap | DiskParameters | MapSnapshot,
    camera: Camera,
    T_cw: GivenPose,
    backend: Backend = "auto",
    near: float = NEAR,
) -> tuple[RenderOutput, PullBack]:
    """Render as :func:`geogs.render` does, and return a function that computes the gradients.

    The maps belong to no graph of PyTorch's, and neither pass goes through its engine, whose
    thread takes longer than the kernels of a small view on a GPU::

        seen, pull_back = geogs.render_vjp(disks, camera, T_cw)
        error = seen.depth - measured
        gradients = pull_back(depth=2 * error)  # of the sum of squares
        gradients.disks.position, gradients.T_cw

    The host waits for a GPU only until the disks are projected. ``reference`` gives the same by
    autograd, to compare with.
    """
    parameters = DiskParameters(*(p.detach() for p in parameters_of(disks)))
    pose = torch.as_tensor(T_cw).detach()
    backend = chosen_backend(parameters, backend)
    run = _by_autograd if backend == "reference" else partial(_compiled, passes_of(backend))
    output, backward = run(parameters, camera, pose, near)
    return output, PullBack(backward, (camera.height, camera.width))


_Rendered = tuple[RenderOutput, Callable[[_Gradients], RenderGradients]]


def _compiled(
    rendered: Forward, disks: DiskParameters, camera: Camera, T_cw: Tensor, near: float
) -> _Rendered:
    maps, back = rendered(disks, camera, T_cw, near, True)
    device = disks.position.device

    def backward(gradients: _Gradients) -> RenderGradients:
        there = [None if g is None else g.detach().to(device) for g in gradients]
        d_disks, d_T = back(there, True)
        assert d_T is not None
        return RenderGradients(d_disks, d_T.view(4, 4))

    return RenderOutput(*maps), backward


def _by_autograd(disks: DiskParameters, camera: Camera, T_cw: Tensor, near: float) -> _Rendered:
    leaves = DiskParameters(*(p.requires_grad_() for p in disks))
    pose = T_cw.to(disks.position.device, torch.float64).clone().requires_grad_()
    with torch.enable_grad():
        graph = render_reference(leaves, camera, pose, near)

    def backward(gradients: _Gradients) -> RenderGradients:
        pairs = zip(graph[:4], gradients, strict=True)
        maps, given = zip(*((m, g.to(m)) for m, g in pairs if g is not None), strict=True)
        inputs = (*leaves, pose)
        *d_disks, d_T = torch.autograd.grad(
            maps, inputs, given, retain_graph=True, materialize_grads=True
        )
        return RenderGradients(DiskParameters(*d_disks), d_T)

    return RenderOutput(*(values.detach() for values in graph)), backward
