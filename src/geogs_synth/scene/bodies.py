"""Rigid things that move through a scene."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from geogs_synth.scene.scene import Scene

Path = Callable[[Float64[np.ndarray, "m"]], Float64[np.ndarray, "m 4 4"]]
"""Body to world at times in seconds."""


@dataclass(frozen=True)
class Body:
    """Solids that move together."""

    shape: Scene
    """In the body's frame; its lights and its sky are left out."""
    path: Path
