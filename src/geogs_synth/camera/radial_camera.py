"""A pinhole camera with or without radial distortion, and a lens that changes over time."""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float64, Int64

from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs_synth.camera.flaws import Flaws

_FOCUS_PERIODS = np.array([1.1, 2.3, 4.7])
"""Periods of the waves of the focus, seconds."""
_SHAKE_PERIODS = np.array([0.17, 0.31, 0.7])
"""Periods of a hand's shake, which the stabilisation counteracts, seconds."""


@dataclass(frozen=True)
class RadialCamera:
    """A pinhole camera with the radial distortion of OpenCV.

    A ray (x, y, 1) at the radius r is seen at the pixel where the pinhole sees
    (x, y) (1 + k1 r^2 + k2 r^4).
    """

    camera: Camera
    k1: float = 0.0
    k2: float = 0.0

    def __post_init__(self) -> None:
        """Raises InputError if the image would be folded over itself."""
        reach = self._radius(np.linspace(0, self._pinhole_reach, 200))
        if not np.isfinite(reach).all():
            raise InputError(
                f"k1 {self.k1:g} and k2 {self.k2:g} fold the image over itself; choose smaller "
                f"ones."
            )

    @staticmethod
    def of(camera: "Camera | RadialCamera") -> "RadialCamera":
        """A camera without distortion, if it is not one of these already."""
        return camera if isinstance(camera, RadialCamera) else RadialCamera(camera)

    @property
    def is_distorted(self) -> bool:
        """Whether straight lines look bent."""
        return self.k1 != 0 or self.k2 != 0

    @property
    def pixel(self) -> tuple[float, float]:
        """Width and height of a pixel on the plane z = 1, in the middle of the image."""
        x, y = self._axes
        return abs(float(x[1] - x[0])), abs(float(y[1] - y[0]))

    @cached_property
    def rays(self) -> tuple[Float64[np.ndarray, "h w"], Float64[np.ndarray, "h w"]]:
        """x and y of the ray (x, y, 1) through the centre of every pixel."""
        x, y = self._planes
        if self.k1 == 0 and self.k2 == 0:
            return x, y
        bent = np.hypot(x, y)
        straight = self._radius(bent) / np.maximum(bent, 1e-12)
        straight[bent < 1e-12] = 1.0
        return x * straight, y * straight

    def pixel_boxes(
        self,
        low: Float64[np.ndarray, "*b 2"],
        high: Float64[np.ndarray, "*b 2"],
        margin: float = 0.0,
    ) -> Int64[np.ndarray, "*b 4"]:
        """Left, top, right, bottom (exclusive) of the pixels whose rays may lie in boxes of x, y.

        Args:
            low: smallest x and y of each box on the plane z = 1.
            high: the largest.
            margin: pixels to add all around.
        """
        c = self.camera
        size = np.array([c.width, c.height])
        if self.is_distorted:
            left, right = _indices(self.rays[0], low[..., 0], high[..., 0], axis=0)
            top, bottom = _indices(self.rays[1], low[..., 1], high[..., 1], axis=1)
            first = np.stack([left, top], -1)
            last = np.stack([right, bottom], -1)
        else:
            focal = np.array([c.fx, c.fy])
            centre = np.array([c.cx, c.cy])
            first = np.ceil(focal * low + centre)
            last = np.floor(focal * high + centre + 1)
        first = np.clip(first - margin, 0, size)
        last = np.clip(last + margin, 0, size)
        return np.concatenate([first, last], -1).astype(np.int64)

    @property
    def view(self) -> tuple[float, float, float, float]:
        """Left, top, right and bottom end of the view on the plane z = 1, a pixel wider."""
        c = self.camera
        (x, y) = self.rays
        if self.is_distorted:
            dx, dy = 2 / c.fx, 2 / c.fy
            return x.min() - dx, y.min() - dy, x.max() + dx, y.max() + dy
        left, right = -(c.cx + 1) / c.fx, (c.width - c.cx) / c.fx
        return left, -(c.cy + 1) / c.fy, right, (c.height - c.cy) / c.fy

    @property
    def _axes(self) -> tuple[Float64[np.ndarray, "w"], Float64[np.ndarray, "h"]]:
        c = self.camera
        return (np.arange(c.width) - c.cx) / c.fx, (np.arange(c.height) - c.cy) / c.fy

    @property
    def _planes(self) -> tuple[Float64[np.ndarray, "h w"], Float64[np.ndarray, "h w"]]:
        """Undistorted :attr:`rays`."""
        x, y = np.meshgrid(*self._axes)
        return x, y

    @property
    def _pinhole_reach(self) -> float:
        x, y = self._axes
        return float(np.hypot(np.abs(x).max(), np.abs(y).max()))

    def _radius(self, bent: Float64[np.ndarray, "*b"]) -> Float64[np.ndarray, "*b"]:
        """The radius r with r (1 + k1 r^2 + k2 r^4) = ``bent``; NaN beyond a fold (bisection)."""
        grid = np.linspace(0, 4 * max(self._pinhole_reach, 1e-6), 4000)
        slope = 1 + 3 * self.k1 * grid**2 + 5 * self.k2 * grid**4
        folds = np.flatnonzero(slope <= 0)
        end = grid[folds[0] - 1] if len(folds) else grid[-1]
        low, high = np.zeros_like(bent), np.full_like(bent, end)
        beyond = bent > self._bend(np.full_like(bent, end))
        for _ in range(60):
            middle = (low + high) / 2
            inside = self._bend(middle) < bent
            low, high = np.where(inside, middle, low), np.where(inside, high, middle)
        return np.where(beyond, np.nan, (low + high) / 2)

    def _bend(self, radius: Float64[np.ndarray, "*b"]) -> Float64[np.ndarray, "*b"]:
        square = radius * radius
        return radius * (1 + self.k1 * square + self.k2 * square * square)


def _indices(
    values: np.ndarray, low: np.ndarray, high: np.ndarray, axis: int
) -> tuple[np.ndarray, np.ndarray]:
    """Columns (rows) in which any of ``values``, which grow with them, lies within each range."""
    return (
        np.searchsorted(values.max(axis), low, side="left"),
        np.searchsorted(values.min(axis), high, side="right"),
    )


class MovingLens:
    """A lens whose focal length changes by focusing, its principal point by stabilisation."""

    def __init__(self, lens: RadialCamera, flaws: Flaws, seed: int = 0) -> None:
        self._lens = lens
        self._flaws = flaws
        self._phases = np.random.default_rng([seed, 0x1E5]).uniform(0, 2 * np.pi, (3, 3))

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
        flaws = self._flaws
        camera = self._lens.camera
        focus = _wave(times, _FOCUS_PERIODS, self._phases[0])
        right, down = (_wave(times, _SHAKE_PERIODS, phase) for phase in self._phases[1:])
        factor = 1 + flaws.focusing * focus
        fx, fy = factor * camera.fx, factor * camera.fy
        cx = camera.cx + flaws.stabilisation * right * fx
        cy = camera.cy + flaws.stabilisation * down * fy
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
