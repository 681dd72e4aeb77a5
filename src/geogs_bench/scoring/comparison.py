"""A mesh beside the truth: what pictures of its error are made from."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from geogs.evaluation.surfaces.surface import Surface


@dataclass(frozen=True)
class Comparison:
    """A mesh in the frame of the truth, and its errors at points on it."""

    mesh: Surface
    truth: Surface | None
    """None where the truth is no mesh."""
    points: Float[np.ndarray, "n 3"]
    errors_cm: Float[np.ndarray, "n"]
    limit_cm: float
    """What pictures show as the worst."""
