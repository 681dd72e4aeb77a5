"""Common parts of the training of all networks."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from torch import distributed

from geogs.depth.network.model import DepthNetwork
from geogs.tracking.flow.own_network import FlowNetwork

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


def write_weights(network: FlowNetwork | DepthNetwork, path: Path, step: int, **about: Any) -> None:
    """Write a network in half precision, with its sizes and dataclasses ``about`` as metadata."""
    tensors = {k: v.detach().cpu().half().contiguous() for k, v in network.state_dict().items()}
    about = {"options": network.options, **about}
    metadata = {name: json.dumps(asdict(value)) for name, value in about.items()}
    temporary = path.with_name(f".{path.name}")
    save_file(tensors, temporary, {**metadata, "step": str(step)})
    temporary.replace(path)
