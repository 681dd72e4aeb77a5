"""Choice of the monocular prior by the settings."""

from pathlib import Path
from typing import TYPE_CHECKING

from geogs.config import PriorConfig
from geogs.geometry.camera import Camera

if TYPE_CHECKING:
    import torch

    from geogs.priors.monocular_prior import MonocularPrior


def open_prior(
    config: PriorConfig, camera: Camera, device: "torch.device"
) -> "MonocularPrior | None":
    """The prior for images of ``camera``; None where no model is named.

    Raises InputError if a file is missing or does not fit its card.
    """
    from geogs.priors.monocular_prior import CombinedPrior

    depth = _open(config.model, config.card, "prior.card", camera, device)
    normal = _open(config.normal_model, config.normal_card, "prior.normal-card", camera, device)
    if depth is None or normal is None:
        return depth or normal
    return CombinedPrior(depth, normal)


def _open(
    model: str, card_name: str, option: str, camera: Camera, device: "torch.device"
) -> "MonocularPrior | None":
    from geogs.errors import InputError
    from geogs.priors.card import card_names, load_card

    if not model:
        return None
    if not card_name:
        raise InputError(
            f"--{option} must say what {model} wants and gives: a YAML file, or one of "
            f"{', '.join(card_names())}."
        )
    from geogs.priors.onnx import OnnxPrior

    return OnnxPrior(Path(model), load_card(card_name), camera, device)
