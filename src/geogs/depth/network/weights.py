"""Reading the depth network's weights file."""

import json
from dataclasses import dataclass
from pathlib import Path

from safetensors import safe_open

from geogs.depth.network.calibration import DepthCalibration
from geogs.depth.network.model import DepthNetwork
from geogs.depth.network.network_sizes import DepthNetworkOptions
from geogs.documents import in_short
from geogs.errors import InputError


@dataclass(frozen=True)
class TrainedDepth:
    """A network and what makes its words hold."""

    network: DepthNetwork
    calibration: DepthCalibration


def load_depth_network(path: Path) -> TrainedDepth:
    """The network of a weights file; raises InputError where it is missing or another's."""
    if not path.is_file():
        raise InputError(
            f"There are no weights of the depth network at {path}; train some with geogs train "
            "depth, or take --mapping.depth.engine classical."
        )
    try:
        with safe_open(path, "pt") as file:
            header = file.metadata() or {}
            values, calibration = (json.loads(header[n]) for n in ("options", "calibration"))
            tensors = {key: file.get_tensor(key).float() for key in file.keys()}  # noqa: SIM118
        values = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
        network = DepthNetwork(DepthNetworkOptions(**values))
        network.load_state_dict(tensors)
        found = TrainedDepth(network, DepthCalibration(**calibration))
    except Exception as error:
        raise InputError(
            f"{path} does not hold weights of our depth network ({in_short(error)})."
        ) from error
    network.eval().requires_grad_(False)
    return found
