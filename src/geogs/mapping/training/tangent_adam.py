"""Adam on a handful of pose tangents."""

import torch
from torch import Tensor


class TangentAdam:
    """Adam (Kingma & Ba 2015) on one small tensor.

    As ``torch.optim.Adam``, whose first use imports PyTorch's compiler, which takes seconds.
    """

    def __init__(
        self,
        parameter: Tensor,
        rate: float,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
    ) -> None:
        self.parameter, self.rate, self.betas, self.eps = parameter, rate, betas, eps
        self._first, self._second = torch.zeros_like(parameter), torch.zeros_like(parameter)
        self._steps = 0

    @torch.no_grad()
    def step(self, gradient: Tensor) -> None:
        """Move the parameter against the gradient; numbers that are not finite count as zero."""
        g = gradient.nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)
        self._steps += 1
        self._first.lerp_(g, 1 - self.betas[0])
        self._second.mul_(self.betas[1]).addcmul_(g, g, value=1 - self.betas[1])
        c1, c2 = (1 - beta**self._steps for beta in self.betas)
        self.parameter -= self.rate / c1 * self._first / ((self._second / c2).sqrt() + self.eps)
