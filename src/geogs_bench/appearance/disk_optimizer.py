"""Adam with a learning rate for each parameter, for a changing number of disks."""

import torch
from jaxtyping import Int
from torch import Tensor

from geogs_bench.appearance.appearance_config import AppearanceConfig
from geogs_bench.appearance.appearance_disks import AppearanceDisks

_MOMENTS = ("exp_avg", "exp_avg_sq")


class DiskOptimizer:
    """The disks in training and their moments, which are kept when disks are added or removed."""

    def __init__(self, disks: AppearanceDisks, config: AppearanceConfig, means_rate: float):
        self.disks = disks.map(_parameter)
        """The parameters; each has its gradient."""
        rates = (
            means_rate, config.quaternions_rate, config.scales_rate, config.opacities_rate,
            config.sh_constant_rate, config.sh_rest_rate,
        )  # fmt: skip
        groups = [
            {"params": [tensor], "lr": rate}
            for tensor, rate in zip(self.disks.tensors(), rates, strict=True)
        ]
        self._adam = torch.optim.Adam(groups, eps=1e-15, fused=disks.means.is_cuda)

    def step(self, means_rate: float) -> None:
        """Take a step along the gradients, and drop them."""
        self._adam.param_groups[0]["lr"] = means_rate
        self._adam.step()
        self._adam.zero_grad(set_to_none=True)

    def change(self, kept: Int[Tensor, "k"], added: AppearanceDisks) -> None:
        """Keep these rows with their moments, and append disks with zero moments."""
        tensors = []
        pairs = zip(self._adam.param_groups, added.tensors(), strict=True)
        for group, new in pairs:
            (old,) = group["params"]
            tensor = _parameter(torch.cat([old.detach()[kept], new]))
            state = self._adam.state.pop(old, None)
            if state:
                for name in _MOMENTS:
                    state[name] = torch.cat([state[name][kept], torch.zeros_like(new)])
                self._adam.state[tensor] = state
            group["params"] = [tensor]
            tensors.append(tensor)
        self.disks = AppearanceDisks(*tensors)


def _parameter(tensor: Tensor) -> Tensor:
    return tensor.detach().clone().requires_grad_()
