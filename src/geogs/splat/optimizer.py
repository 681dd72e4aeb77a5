"""Adam for a map whose disks come, go and move."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.world.disks import GaussianMap

BETAS, EPSILON = (0.9, 0.99), 1e-8
"""Of Adam: decay of both moments, and what is added to the root of the second."""


class LearningRates(NamedTuple):
    """Adam step sizes per group."""

    position: float
    """Map units."""
    quaternion: float
    log_scale: float
    opacity_logit: float


class MapOptimizer:
    """Adam (Kingma & Ba 2015) on a map's disks, with a step count per disk.

    Only disks given as visible are stepped: the moments and the step counts of the others stand
    still, so a disk out of view neither drifts nor forgets. Bias correction uses each disk's own
    count. The moments are the map's, and follow where disks come, go and move.
    """

    def __init__(self, disks: GaussianMap, learning_rates: LearningRates) -> None:
        self.disks = disks
        self.learning_rates = learning_rates
        first, second = (_bias_corrections(beta).to(disks.device) for beta in BETAS)
        self._corrections = (first, second)

    def zero_grad(self) -> None:
        """Forget the gradients."""
        for p in self.disks.parameters:
            p.grad = None

    @torch.no_grad()
    def step(self, visible: Bool[Tensor, "n"]) -> None:
        """One Adam step of the visible disks by the gradients accumulated in the map's tensors.

        A parameter group without gradient is left alone.
        """
        disks = self.disks
        disks.steps += visible
        groups = zip(disks.parameters, disks.first, disks.second, self.learning_rates, strict=True)
        update = adam_reference
        if self._is_fused():
            from geogs.splat.cpu.adam import adam_rows

            update = adam_rows
        for p, m, v, rate in groups:
            if p.grad is not None:
                update(
                    p, p.grad, m, v, visible, disks.steps, self._corrections,
                    rate, BETAS, EPSILON,
                )  # fmt: skip

    def _is_fused(self) -> bool:
        p = self.disks.position
        return p.device.type == "cpu" and p.dtype == torch.float32


def adam_reference(
    p: Tensor,
    grad: Tensor,
    first: Tensor,
    second: Tensor,
    visible: Tensor,
    steps: Tensor,
    corrections: tuple[Tensor, Tensor],
    rate: float,
    betas: tuple[float, float],
    eps: float,
) -> None:
    """One Adam step of the visible rows in plain PyTorch, in place: the kernel's specification."""
    g = grad[visible]
    m = first[visible].lerp(g, 1 - betas[0])
    v = second[visible].lerp(g * g, 1 - betas[1])
    first[visible], second[visible] = m, v
    row = (-1,) + (1,) * (p.dim() - 1)
    c1, c2 = (c[steps[visible].clamp(max=len(c) - 1)].view(row).to(p.dtype) for c in corrections)
    p[visible] -= rate * (m / c1) / ((v / c2).sqrt() + eps)


def _bias_corrections(beta: float) -> Float[Tensor, "t"]:
    """1 - beta^t for t = 0, 1, ... until it is one in float32."""
    count = math.ceil(math.log(1e-8) / math.log(beta)) + 1
    return 1 - beta ** torch.arange(count, dtype=torch.float64)
