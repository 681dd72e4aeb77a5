"""What the courses of all networks have in common."""

from dataclasses import dataclass

import torch

Panels = tuple[tuple[str, tuple[str, ...], bool], ...]
"""Pictures of scores: title, names of scores, whether on a logarithmic scale."""


@dataclass(frozen=True)
class Worker:
    """This process among those that train together, one for each device."""

    device: torch.device
    rank: int = 0
    count: int = 1
