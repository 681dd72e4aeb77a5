"""A lens that changes as time goes on: focus breathing and optical stabilisation."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float64

from geogs.geometry.camera import Camera
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

    @property
    def is_still(self) -> bool:
        """Whether nothing of it changes."""
        return self._flaws.focusing == 0 and self._flaws.stabilisation == 0

    def in_rows(self, times: Float64[np.ndarray, "h"]) -> RadialCamera:
        """The lens of an image whose rows are taken at these seconds."""
        if self.is_still:
            return self._lens
        rows = tuple(self.at(time).camera for time in times.tolist())
        return _LensInRows(rows[len(rows) // 2], self._lens.k1, self._lens.k2, rows)

    def at(self, time: float) -> RadialCamera:
        """The lens at ``time`` seconds."""
        flaws, camera = self._flaws, self._lens.camera
        if self.is_still:
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


@dataclass(frozen=True)
class _LensInRows(RadialCamera):
    """A lens that changes while an image is read."""

    rows: tuple[Camera, ...] = ()
    """Its pinhole at the time of each row."""

    @property
    def is_distorted(self) -> bool:
        """Straight lines look bent where it moves."""
        return True

    @cached_property
    def _planes(self) -> tuple[Float64[np.ndarray, "h w"], Float64[np.ndarray, "h w"]]:
        c = np.array([(c.fx, c.fy, c.cx, c.cy) for c in self.rows])[..., None]
        v, u = np.mgrid[: self.camera.height, : self.camera.width]
        return (u - c[:, 2]) / c[:, 0], (v - c[:, 3]) / c[:, 1]


def _wave(
    time: float, periods: Float64[np.ndarray, "k"], phases: Float64[np.ndarray, "k"]
) -> float:
    """Between -1 and 1."""
    return float(np.sin(2 * np.pi * time / periods + phases).mean())
