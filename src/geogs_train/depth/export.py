"""The depth network's trained weights as they are shipped."""

import json
from dataclasses import asdict
from pathlib import Path

import torch
from safetensors.torch import save_file

from geogs.depth.network.model import DepthNetwork
from geogs_train.depth.calibrate import calibrated
from geogs_train.depth.scores import DepthErrors, DepthScores


def export_depth_weights(
    network: DepthNetwork, path: Path, step: int, scores: DepthScores, held_out: list[DepthErrors]
) -> None:
    """Write a network in half precision; sizes, scores and calibration are in the metadata."""
    tensors = {k: v.detach().cpu().to(torch.float16) for k, v in network.state_dict().items()}
    metadata = {
        "options": json.dumps(asdict(network.options)),
        "calibration": json.dumps(asdict(calibrated(DepthErrors.join(held_out)))),
        "step": str(step),
        "scores": json.dumps(asdict(scores)),
    }
    temporary = path.with_name(f".{path.name}")
    save_file({k: v.contiguous() for k, v in tensors.items()}, temporary, metadata)
    temporary.replace(path)
