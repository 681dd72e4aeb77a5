"""Poses of the hand-held path, as many as a test asks for."""

import numpy as np
from jaxtyping import Float64

from geogs_synth.motion.handheld import HandheldPath
from geogs_synth.scene.textured_scene import Scene


def handheld_trajectory(scene: Scene, frames: int, seed: int = 0) -> Float64[np.ndarray, "n 4 4"]:
    """Camera to world at 30 frames a second."""
    return HandheldPath(scene, seed).at_frames(np.arange(frames))
