"""What a network gives, as depth and normals of the image."""

import numpy as np
from jaxtyping import Float

from geogs.errors import InputError
from geogs.priors.card import PriorCard
from geogs.priors.fitting import FittedImage

MIN_NORMAL = 0.2
"""Shorter normals than this mean that the network does not know."""


def depth_map(output: np.ndarray, fitted: FittedImage, card: PriorCard) -> Float[np.ndarray, "h w"]:
    """A network's depth, (1, 1, h, w) or fewer leading ones, at the size of the image."""
    values = np.asarray(output, np.float32)
    if values.ndim < 2 or values.size != values.shape[-1] * values.shape[-2]:
        raise InputError(f"Depth of {card.name} has shape {values.shape}, not (1, 1, h, w).")
    values = values.reshape(values.shape[-2:])
    if card.depth_range:
        values = values.clip(card.depth_range[0], card.depth_range[1])
    return fitted.back(values)


def normal_map(
    output: np.ndarray, fitted: FittedImage, card: PriorCard
) -> Float[np.ndarray, "h w 3"]:
    """A network's normals, (1, 3 or more, h, w), in our axes and of unit length; zero if short."""
    values = np.asarray(output, np.float32)
    if values.ndim != 4 or values.shape[0] != 1 or values.shape[1] < 3:
        raise InputError(f"Normals of {card.name} have shape {values.shape}, not (1, 3, h, w).")
    scaled = card.normal_scale * values[0, :3] + card.normal_offset
    scaled = scaled.transpose(1, 2, 0) * np.array(card.axes, np.float32)
    normal = fitted.back(np.ascontiguousarray(scaled, np.float32))
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.where(length < MIN_NORMAL, 0, normal / np.maximum(length, 1e-6)).astype(np.float32)
