"""Trained weights as they are shipped."""

import json
from dataclasses import asdict
from pathlib import Path

import torch
from safetensors.torch import save_file

from geogs.tracking.flow.own_network import FlowNetwork
from geogs_train.validation import SceneScores


def export_weights(network: FlowNetwork, path: Path, step: int, scores: SceneScores) -> None:
    """Write a network in half precision, with its sizes and scores as metadata."""
    tensors = {k: v.detach().cpu().to(torch.float16) for k, v in network.state_dict().items()}
    metadata = {
        "options": json.dumps(asdict(network.options)),
        "step": str(step),
        "scores": json.dumps(asdict(scores)),
    }
    temporary = path.with_name(f".{path.name}")
    save_file({k: v.contiguous() for k, v in tensors.items()}, temporary, metadata)
    temporary.replace(path)
