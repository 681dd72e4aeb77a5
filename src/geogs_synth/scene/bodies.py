"""Rigid bodies that move through a scene."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from geogs_synth.scene.textured_scene import Scene

Path = Callable[[Float64[np.ndarray, "m"]], Float64[np.ndarray, "m 4 4"]]
"""Body to world at times in seconds."""


@dataclass(frozen=True)
class Body:
    """Solids that move together."""

    shape: Scene
    """In the body's frame; its lights and its sky are left out."""
    path: Path


def upright_poses(
    position: Float64[np.ndarray, "m 3"],
    cosine: Float64[np.ndarray, "m"],
    sine: Float64[np.ndarray, "m"],
) -> Float64[np.ndarray, "m 4 4"]:
    """Body to world for bodies that stand upright, by the cosine and sine of their yaw."""
    T_wb = np.tile(np.eye(4), (len(position), 1, 1))
    T_wb[:, 0, 0] = T_wb[:, 1, 1] = cosine
    T_wb[:, 1, 0] = sine
    T_wb[:, 0, 1] = -sine
    T_wb[:, :3, 3] = position
    return T_wb
