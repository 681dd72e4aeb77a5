"""Takes the frames of a moving camera: every row at its own time, over its exposure."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from geogs_synth.camera.flaws import Flaws
from geogs_synth.camera.radial_camera import MovingLens, RadialCamera
from geogs_synth.camera.sensors import ImageSensor
from geogs_synth.raycast.raycaster import Raycaster, RenderedView
from geogs_synth.scene.bodies import Body, Path

_SHARP = 0.5
"""Largest motion of an image during its exposure that counts as sharp, pixels."""
_MIN_SAMPLES, _MAX_SAMPLES = 5, 24
_GRID = 16
"""Points across the image whose motion is measured."""


@dataclass(frozen=True)
class Shot:
    """A frame and the truth about it."""

    time: float
    """Seconds; mid-exposure of the middle row."""
    T_wc: Float64[np.ndarray, "4 4"]
    """Camera to world, for the middle row at mid-exposure."""
    image: UInt8[np.ndarray, "h w 3"]
    """RGB, with all flaws."""
    truth: RenderedView
    """Render of the same lens, without a shutter, from ``T_wc``."""
    moving: np.ndarray
    """h w, bool: mask of the bodies in ``truth``."""


class Shooting:
    """A camera with flaws that moves through a scene.

    Row v of h is taken at (v / (h - 1) - 1/2) readout from the time of its frame.
    """

    def __init__(
        self,
        raycaster: Raycaster,
        lens: RadialCamera,
        path: Path,
        flaws: Flaws,
        rate: float = 30.0,
        seed: int = 0,
    ) -> None:
        """``rate`` in frames per second; the moving bodies are those of the raycaster."""
        self.lens = lens
        self._raycaster = raycaster
        self._path = path
        self._flaws = flaws
        self._rate = rate
        self._sensor = ImageSensor(flaws, lens.camera, seed)
        self._moving_lens = MovingLens(lens, flaws, seed)

    def shoot(self, index: int) -> Shot:
        """The frame with this number."""
        time = index / self._rate
        T_wc = self._path(np.array([time]))[0]
        truth = self._raycaster.render(self.lens, T_wc, time)
        moving = truth.solid >= len(self._raycaster.scene)
        if self._flaws == Flaws():
            image = truth.image
        else:
            image = self._sensor.develop(self._light(truth, T_wc, time), index, time)
        return Shot(time, T_wc, image, truth, moving)

    def sample_times(
        self, truth: RenderedView, T_wc: np.ndarray, time: float
    ) -> Float64[np.ndarray, "s"]:
        """Times of the middle row at which light is sampled; more where the image moves more."""
        exposure = self._flaws.exposure
        ends = time + exposure * np.array([-0.5, 0.5])
        motion = self._image_motion(truth, T_wc, time, ends) if exposure else 0.0
        if motion < _SHARP:
            return np.array([time])
        count = min(max(_MIN_SAMPLES, math.ceil(motion)), _MAX_SAMPLES)
        return time + exposure * ((np.arange(count) + 0.5) / count - 0.5)

    def row_times(self) -> Float64[np.ndarray, "h"]:
        """Time of every row relative to its frame, seconds."""
        rows = self.lens.camera.height
        return (np.arange(rows) / (rows - 1) - 0.5) * self._flaws.readout

    def _light(
        self, truth: RenderedView, T_wc: np.ndarray, time: float
    ) -> Float32[np.ndarray, "h w 3"]:
        """Mean linear light in [0, 1] over the exposure."""
        times = self.sample_times(truth, T_wc, time)
        if len(times) == 1 and self._flaws.readout == 0 and self._moving_lens.is_still:
            return (truth.shade / 255) ** 2
        light = np.zeros_like(truth.shade)
        for one in times:
            light += (self._instant(one).shade / 255) ** 2
        return light / len(times)

    def _instant(self, time: float) -> RenderedView:
        lens = self._moving_lens
        if self._flaws.readout == 0:
            return self._raycaster.render(lens.at(time), self._path(np.array([time]))[0], time)
        times = time + self.row_times()
        return self._raycaster.render_rolling(lens.in_rows(times), self._path(times), times)

    def _image_motion(
        self, truth: RenderedView, T_wc: np.ndarray, time: float, ends: np.ndarray
    ) -> float:
        """Largest motion in the image between two times, pixels."""
        step = max(1, self.lens.camera.width // _GRID)
        some = slice(step // 2, None, step)
        x, y = (axis[some, some].ravel() for axis in self.lens.rays)
        depth = truth.depth[some, some].ravel()
        solid = truth.solid[some, some].ravel()
        # The sky is farther than anything else.
        depth = np.where(depth > 0, depth, 1e4)
        points = np.stack([x, y, np.ones_like(x)], 1) * depth[:, None]
        world = points @ T_wc[:3, :3].T + T_wc[:3, 3]
        at_ends = np.repeat(world[None], 2, 0)
        for first, body in self._raycaster.bodies():
            own = (solid >= first) & (solid < first + len(body.shape))
            at_ends[:, own] = _moved_along(body, world[own], time, ends)
        T_cw = np.linalg.inv(self._path(ends))
        seen = at_ends @ T_cw[:, :3, :3].transpose(0, 2, 1) + T_cw[:, None, :3, 3]
        plane = seen[..., :2] / np.maximum(seen[..., 2:], 1e-3)
        moved = np.linalg.norm(plane[1] - plane[0], axis=1)
        return float(moved.max() * self.lens.camera.fx)


def _moved_along(
    body: Body, world: np.ndarray, time: float, ends: np.ndarray
) -> Float64[np.ndarray, "e n 3"]:
    """Positions at other times of points on a body at ``time``."""
    T_bw = np.linalg.inv(body.path(np.array([time]))[0])
    T_wb = body.path(ends)
    local = world @ T_bw[:3, :3].T + T_bw[:3, 3]
    return local @ T_wb[:, :3, :3].transpose(0, 2, 1) + T_wb[:, None, :3, 3]
