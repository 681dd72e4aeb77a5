"""Rendering with an explicit vector-Jacobian product, without autograd."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.geometry.given_pose import GivenPose
from geogs.splat.protocols import Forward
from geogs.splat.reference import render_reference
from geogs.splat.render import (
    NEAR,
    Backend,
    RenderOutput,
    chosen_backend,
    parameters_of,
    passes_of,
)
from geogs.types import MapSnapshot
from geogs.world.disks import DiskParameters, GaussianMap

_Gradients = tuple[Tensor | None, Tensor | None, Tensor | None, Tensor | None]


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
    pose, backend = torch.as_tensor(T_cw).detach(), chosen_backend(parameters, backend)
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
        graph = RenderOutput(*render_reference(leaves, camera, pose, near))
    depth, normal, alpha, distortion = (m.detach() for m in _differentiable(graph))
    output = RenderOutput(
        depth, normal, alpha, distortion, graph.median_depth.detach(), graph.visible
    )

    def backward(gradients: _Gradients) -> RenderGradients:
        pairs = zip(_differentiable(graph), gradients, strict=True)
        maps, given = zip(*((m, g.to(m)) for m, g in pairs if g is not None), strict=True)
        inputs = (*leaves, pose)
        *d_disks, d_T = torch.autograd.grad(
            maps, inputs, given, retain_graph=True, materialize_grads=True
        )
        return RenderGradients(DiskParameters(*d_disks), d_T)

    return output, backward


def _differentiable(output: RenderOutput) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return output.depth, output.normal, output.alpha, output.distortion
