"""Trained weights for shipping."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from safetensors.torch import save_file

from geogs.depth.network.model import DepthNetwork
from geogs.tracking.flow.own_network import FlowNetwork


def write_weights(network: FlowNetwork | DepthNetwork, path: Path, step: int, **about: Any) -> None:
    """Write a network in half precision, with its sizes and dataclasses ``about`` as metadata."""
    tensors = {k: v.detach().cpu().half().contiguous() for k, v in network.state_dict().items()}
    about = {"options": network.options, **about}
    metadata = {name: json.dumps(asdict(value)) for name, value in about.items()}
    temporary = path.with_name(f".{path.name}")
    save_file(tensors, temporary, {**metadata, "step": str(step)})
    temporary.replace(path)
