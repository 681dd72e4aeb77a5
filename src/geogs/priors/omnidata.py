"""Omnidata's networks for depth and for normals, from their published checkpoints."""

import pickle
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from geogs.documents import open_file
from geogs.errors import InputError
from geogs.priors.card import PriorCard
from geogs.priors.dpt import MULTIPLE, DptHybrid
from geogs.priors.fitting import fit_image, prior_maps
from geogs.priors.monocular_prior import PriorMaps

PREFIX = "model."
"""Before every name of the checkpoints, which hold more than the network."""


class OmnidataPrior:
    """Depth or normals of single images by DPT-Hybrid; a card says which."""

    def __init__(self, model: Path, card: PriorCard, device: torch.device | str = "cpu") -> None:
        """Raises InputError if the file is not a checkpoint of the network."""
        if (card.depth_kind is None) == (card.axes is None) or card.multiple % MULTIPLE:
            raise InputError(
                f"The card {card.name} must give either depth or normals, at a multiple of "
                f"{MULTIPLE} pixels."
            )
        self.card = card
        self.device = torch.device(device)
        with torch.device("meta"):  # the checkpoint brings every number
            network = DptHybrid(1 if card.axes is None else 3)
        load_checkpoint(network, model)
        self.network = network.to(self.device).eval().requires_grad_(False)

    @torch.inference_mode()
    def predict(self, image: UInt8[np.ndarray, "h w 3"]) -> PriorMaps:
        """Depth or normals at the size of the image, on the CPU."""
        fitted = fit_image(image, self.card)
        output = self.network(torch.from_numpy(fitted.pixels).to(self.device)).cpu().numpy()
        if self.card.axes is None:
            return prior_maps(output, None, fitted, self.card)
        return prior_maps(None, output, fitted, self.card)


def load_checkpoint(network: DptHybrid, path: Path) -> None:
    """Take over every weight of a checkpoint, all of which must be there and none besides.

    Raises InputError with what is missing or too much.
    """
    weights = _weights(path)
    expected = {k: v.shape for k, v in network.state_dict().items()}
    missing, extra = sorted(expected.keys() - weights.keys()), sorted(weights.keys() - expected)
    shapes = [k for k in expected.keys() & weights.keys() if weights[k].shape != expected[k]]
    for names, what in ((missing, "lacks"), (extra, "has, besides,"), (shapes, "has in a shape")):
        if names:
            more = f" and {len(names) - 1} others" if len(names) > 1 else ""
            rest = " that does not fit" if names is shapes else ""
            raise InputError(
                f"{path} is not this network's checkpoint: it {what} {names[0]}{more}{rest}."
            )
    network.load_state_dict({k: v.float() for k, v in weights.items()}, strict=True, assign=True)


def _weights(path: Path) -> dict[str, Tensor]:
    """The network's part of a checkpoint."""
    if not path.is_file():
        raise InputError(f"There is no file {path} with a monocular network.")
    try:
        with open_file(path) as file:
            content = torch.load(file, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        raise InputError(
            f"{path} holds more than numbers, which is not read for safety; keep the field "
            "state_dict alone: torch.save({'state_dict': torch.load(FILE, weights_only=False)"
            "['state_dict']}, NEW)."
        ) from error
    except Exception as error:  # whatever a damaged file makes the reader stumble over
        raise InputError(f"{path} cannot be read as a checkpoint of PyTorch.") from error
    content = content.get("state_dict", content) if isinstance(content, dict) else {}
    named = {str(k).removeprefix(PREFIX): v for k, v in content.items() if isinstance(v, Tensor)}
    if not named:
        raise InputError(f"{path} holds no weights.")
    return named
