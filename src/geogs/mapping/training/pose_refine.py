"""Pose-only refinement: poses are optimised against the fixed map (Eq. pose_loss)."""

from collections.abc import Callable, Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.config import MappingConfig
from geogs.geometry.lie import retract
from geogs.losses.cpu.fused import fused_multi_view, fused_single_view
from geogs.losses.single_view import MIN_ALPHA
from geogs.mapping.keyframe_views import MapView
from geogs.mapping.view_arrays import MapCameras
from geogs.splat.render import render
from geogs.world.disks import DiskParameters, GaussianMap

BETAS, EPSILON = (0.9, 0.999), 1e-8
"""Adam's decay of both moments, and the number added to the root of the second."""


class TangentAdam:
    """Adam (Kingma & Ba 2015) on one small tensor.

    It replaces ``torch.optim.Adam``, whose first use imports PyTorch's compiler for seconds.
    """

    def __init__(self, parameter: Tensor, rate: float) -> None:
        self.parameter = parameter
        self.rate = rate
        self._first, self._second = torch.zeros_like(parameter), torch.zeros_like(parameter)
        self._steps = 0

    @torch.no_grad()
    def step(self, gradient: Tensor) -> None:
        """Move the parameter against the gradient; numbers that are not finite count as zero."""
        g = gradient.nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)
        self._steps += 1
        self._first.lerp_(g, 1 - BETAS[0])
        self._second.mul_(BETAS[1]).addcmul_(g, g, value=1 - BETAS[1])
        c1, c2 = (1 - beta**self._steps for beta in BETAS)
        self.parameter -= self.rate / c1 * self._first / ((self._second / c2).sqrt() + EPSILON)


Evaluate = Callable[[Float[Tensor, "k 4 4"]], tuple[float, Float[Tensor, ""]]]
"""The loss of some poses, and a differentiable scalar with the same gradient."""


@torch.enable_grad()
def descend(
    start: Float[Tensor, "k 4 4"], config: MappingConfig, unit: float, evaluate: Evaluate
) -> Float[Tensor, "k 4 4"]:
    """Minimise the loss from ``start``; the first pose is fixed.

    Adam on left perturbations [tau, phi], tau in units of the map's depth. The step with the least
    loss is returned; where no step lowered the loss the poses come back as they were.
    """
    tangent = torch.zeros(len(start) - 1, 6, dtype=torch.float64, requires_grad=True)
    units = torch.tensor([unit] * 3 + [1.0] * 3, dtype=torch.float64)
    optimizer = TangentAdam(tangent, config.pose_lr)
    best_loss = float("inf")
    best = start
    for step in range(config.pose_iterations + 1):
        poses = torch.cat([start[:1], retract(tangent * units, start[1:])])
        loss, differentiable = evaluate(poses)
        if loss < best_loss:
            best_loss = loss
            best = poses.detach()
        if step < config.pose_iterations:
            optimizer.step(torch.autograd.grad(differentiable, tangent)[0])
    return best


def refine_poses(
    disks: GaussianMap,
    active: list[MapView],
    views: Mapping[int, MapView],
    cameras: MapCameras,
    config: MappingConfig,
    unit: float,
) -> dict[int, Float[Tensor, "4 4"]]:
    """Refined world-to-camera poses of the active keyframes, the earliest of them fixed.

    By :func:`descend` on L_d + L_n + L_mv with the mapping weights.
    """
    frozen = DiskParameters(*(p.detach() for p in disks.parameters))
    losses = config.pose_loss

    def evaluate(poses: Float[Tensor, "k 4 4"]) -> tuple[float, Float[Tensor, ""]]:
        """Sum over active views of L_d + L_n and of L_mv with their best partner."""
        pose_of = {view.id: T for view, T in zip(active, poses, strict=True)}
        total = poses.new_zeros(())
        for view in active:
            T_cw = pose_of[view.id]
            output = render(frozen, cameras.render, T_cw)
            alpha = output.alpha.detach()
            spread = output.distortion.detach()
            total = total + fused_single_view(
                output.depth, output.normal, alpha, spread, view.constants, losses, unit
            )
            depth = output.shown_depth(MIN_ALPHA)
            for i in view.row.partners[:1]:
                other = views[i]
                target = other.photo.at(pose_of.get(i, other.T_cw))
                total = total + fused_multi_view(
                    depth, view.photo.at(T_cw), target, other.rendered_depth, losses
                )
        return float(total.detach()), total

    best = descend(torch.stack([view.T_cw for view in active]), config, unit, evaluate)
    return {view.id: T for view, T in zip(active[1:], best[1:], strict=True)}
