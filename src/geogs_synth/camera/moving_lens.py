"""A lens that is not the same from frame to frame: focused anew, and moved against the shake."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from geogs_synth.camera.flaws import Flaws
from geogs_synth.camera.radial_camera import RadialCamera

_FOCUS_PERIODS = np.array([1.1, 2.3, 4.7])
"""Seconds of the waves in which it is focused."""
_SHAKE_PERIODS = np.array([0.17, 0.31, 0.7])
"""And moved: those of a hand."""
_STREAM = 0x1E5


class MovingLens:
    """Magnifies otherwise as it is focused (focus breathing), and is moved, or its image cropped
    elsewhere, as it is stabilised; all in the plane of the sensor."""

    def __init__(self, lens: RadialCamera, flaws: Flaws, seed: int = 0) -> None:
        self._lens, self._flaws = lens, flaws
        phases = np.random.default_rng([seed, _STREAM]).uniform(0, 2 * np.pi, (3, 3))
        self._phases = phases

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
