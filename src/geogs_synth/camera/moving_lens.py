"""A lens that changes as time goes on: focus breathing and optical stabilisation."""

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float64

from geogs_synth.camera.flaws import Flaws
from geogs_synth.camera.radial_camera import RadialCamera

_FOCUS_PERIODS = np.array([1.1, 2.3, 4.7])
"""Periods of the waves of the focus, seconds."""
_SHAKE_PERIODS = np.array([0.17, 0.31, 0.7])
"""Periods of a hand's shake, which the stabilisation counteracts, seconds."""
_STREAM = 0x1E5


class MovingLens:
    """A lens whose focal length changes by focusing, its principal point by stabilisation."""

    def __init__(self, lens: RadialCamera, flaws: Flaws, seed: int = 0) -> None:
        self._lens, self._flaws = lens, flaws
        self._phases = np.random.default_rng([seed, _STREAM]).uniform(0, 2 * np.pi, (3, 3))

    @property
    def is_still(self) -> bool:
        """Whether its intrinsics are constant."""
        return self._flaws.focusing == 0 and self._flaws.stabilisation == 0

    def in_rows(self, times: Float64[np.ndarray, "h"]) -> RadialCamera:
        """The lens of an image whose rows are taken at these seconds."""
        if self.is_still:
            return self._lens
        lens = self.at(float(times[len(times) // 2]))
        return _LensInRows(lens.camera, lens.k1, lens.k2, rows=self._intrinsics(times))

    def at(self, time: float) -> RadialCamera:
        """The lens at ``time`` seconds."""
        if self.is_still:
            return self._lens
        fx, fy, cx, cy = self._intrinsics(np.array([time]))[0].tolist()
        return replace(self._lens, camera=replace(self._lens.camera, fx=fx, fy=fy, cx=cx, cy=cy))

    def _intrinsics(self, times: Float64[np.ndarray, "t"]) -> Float64[np.ndarray, "t 4"]:
        """fx, fy, cx and cy at times in seconds."""
        flaws, camera = self._flaws, self._lens.camera
        focus = _wave(times, _FOCUS_PERIODS, self._phases[0])
        right, down = (_wave(times, _SHAKE_PERIODS, phase) for phase in self._phases[1:])
        factor = 1 + flaws.focusing * focus
        fx, fy = factor * camera.fx, factor * camera.fy
        cx, cy = (
            camera.cx + flaws.stabilisation * right * fx,
            camera.cy + flaws.stabilisation * down * fy,
        )
        return np.stack([fx, fy, cx, cy], 1)


@dataclass(frozen=True)
class _LensInRows(RadialCamera):
    """A lens that changes while an image is read."""

    rows: Float64[np.ndarray, "h 4"] = field(kw_only=True)
    """fx, fy, cx and cy at the time of each row."""

    @property
    def is_distorted(self) -> bool:
        """True: straight lines look bent where the lens moves."""
        return True

    @property
    def _planes(self) -> tuple[Float64[np.ndarray, "h w"], Float64[np.ndarray, "h w"]]:
        fx, fy, cx, cy = self.rows.T[..., None]
        v, u = np.mgrid[: self.camera.height, : self.camera.width]
        return (u - cx) / fx, (v - cy) / fy


def _wave(
    times: Float64[np.ndarray, "t"],
    periods: Float64[np.ndarray, "k"],
    phases: Float64[np.ndarray, "k"],
) -> Float64[np.ndarray, "t"]:
    """Mean of the sines, between -1 and 1."""
    waves: Float64[np.ndarray, "t"] = np.sin(2 * np.pi * times[:, None] / periods + phases).mean(1)
    return waves
