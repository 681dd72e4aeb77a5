"""Common parts of the training of all networks."""

from dataclasses import dataclass

import torch
from torch import distributed

Panels = tuple[tuple[str, tuple[str, ...], bool], ...]
"""Plots of scores: title, names of scores, whether on a logarithmic scale."""


@dataclass(frozen=True)
class Worker:
    """This process and its rank among the training processes, one for each device."""

    device: torch.device
    rank: int = 0
    count: int = 1

    def generator(self, seed: int, step: int) -> torch.Generator:
        """Random numbers of a step of this worker, on its device."""
        key = hash((seed, step, self.rank)) % 2**62
        return torch.Generator(self.device).manual_seed(key)

    def shared(self, value: float) -> float:
        """Broadcast the first worker's value to all; they wait for each other."""
        if self.count == 1:
            return value
        first = torch.tensor([value], dtype=torch.float64, device=self.device)
        distributed.broadcast(first, 0)
        return float(first.item())
