"""A lens that changes from frame to frame: focus breathing and optical stabilisation."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from geogs_synth.camera.flaws import Flaws
from geogs_synth.camera.radial_camera import RadialCamera

_FOCUS_PERIODS = np.array([1.1, 2.3, 4.7])
"""Periods in seconds of the waves in which it is focused."""
_SHAKE_PERIODS = np.array([0.17, 0.31, 0.7])
"""Periods in seconds of a hand's shake, against which it is moved."""
_STREAM = 0x1E5


class MovingLens:
    """Changes its focal length as it is focused, and its principal point as it is stabilised."""

    def __init__(self, lens: RadialCamera, flaws: Flaws, seed: int = 0) -> None:
        self._lens, self._flaws = lens, flaws
        self._phases = np.random.default_rng([seed, _STREAM]).uniform(0, 2 * np.pi, (3, 3))

    def at(self, time: float) -> RadialCamera:
        """The lens of a frame that is taken at ``time`` seconds."""
        flaws, camera = self._flaws, self._lens.camera
        if flaws.focusing == 0 and flaws.stabilisation == 0:
            return self._lens
        focus = _wave(time, _FOCUS_PERIODS, self._phases[0])
        right, down = (_wave(time, _SHAKE_PERIODS, phase) for phase in self._phases[1:])
        factor = 1 + flaws.focusing * focus
        fx, fy = factor * camera.fx, factor * camera.fy
        moved = replace(
            camera, fx=fx, fy=fy,
            cx=camera.cx + flaws.stabilisation * right * fx,
            cy=camera.cy + flaws.stabilisation * down * fy,
        )  # fmt: skip
        return replace(self._lens, camera=moved)


def _wave(
    time: float, periods: Float64[np.ndarray, "k"], phases: Float64[np.ndarray, "k"]
) -> float:
    """Between -1 and 1."""
    return float(np.sin(2 * np.pi * time / periods + phases).mean())
