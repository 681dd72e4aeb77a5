"""Adam for a map whose disks are added, removed and moved."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.world.disks import GaussianMap

BETAS, EPSILON = (0.9, 0.99), 1e-8
"""Adam's decay of both moments, and the number added to the root of the second."""


class LearningRates(NamedTuple):
    """Adam step sizes per group."""

    position: float
    """Map units."""
    quaternion: float
    log_scale: float
    opacity_logit: float


class MapOptimizer:
    """Adam (Kingma & Ba 2015) on a map's disks on a CPU, with a step count per disk.

    Only disks given as visible are stepped: the moments and the step counts of the others stay, so
    a disk out of view neither drifts nor forgets. Bias correction uses each disk's own count. The
    moments belong to the map, and follow its disks as they are added, removed and moved.
    """

    def __init__(self, disks: GaussianMap, learning_rates: LearningRates) -> None:
        self.disks = disks
        self.learning_rates = learning_rates
        self._corrections = _bias_corrections(BETAS[0]), _bias_corrections(BETAS[1])

    def zero_grad(self) -> None:
        """Discard the gradients."""
        for p in self.disks.parameters:
            p.grad = None

    @torch.no_grad()
    def step(self, visible: Bool[Tensor, "n"]) -> None:
        """One Adam step of the visible disks by the gradients accumulated in the map's tensors.

        A parameter group without gradient is left alone.
        """
        from geogs.splat.cpu.adam import adam_rows

        disks = self.disks
        disks.steps += visible
        groups = zip(disks.parameters, disks.first, disks.second, self.learning_rates, strict=True)
        for p, m, v, rate in groups:
            if p.grad is not None:
                adam_rows(
                    p, p.grad, m, v, visible, disks.steps, self._corrections, rate, BETAS, EPSILON
                )


def _bias_corrections(beta: float) -> Float[Tensor, "t"]:
    """1 - beta^t for t = 0, 1, ... until it is one in float32."""
    count = math.ceil(math.log(1e-8) / math.log(beta)) + 1
    return 1 - beta ** torch.arange(count, dtype=torch.float64)
