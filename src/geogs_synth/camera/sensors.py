"""Sensors: images from light, and depth as a triangulating sensor measures it."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

from geogs.geometry.camera import Camera
from geogs_synth.camera.flaws import Flaws

_CLOSED = np.ones((3, 3), np.uint8)
_PERIODS = np.array([1.7, 2.9, 5.3])
"""Periods of the waves that the automatic exposure and white balance follow, seconds."""


class ImageSensor:
    """Makes images of light; the same frame of the same seed has the same noise."""

    def __init__(self, flaws: Flaws, camera: Camera, seed: int = 0) -> None:
        self._flaws = flaws
        self._seed = seed
        self._shading = _lens_shading(camera, flaws.vignetting)
        rng = np.random.default_rng([seed, 0xD1F])
        self._phases = rng.uniform(0, 2 * np.pi, (2, len(_PERIODS)))

    def develop(
        self, light: Float32[np.ndarray, "h w 3"], frame: int, time: float
    ) -> UInt8[np.ndarray, "h w 3"]:
        """Return the image of linear light in [0, 1], taken as frame ``frame`` at ``time`` s.

        Display gamma is 2, so that the shot noise of the light, whose variance grows with the
        light, has the same deviation at every grey level.
        """
        gains = self.gains(time)
        shown = 255 * np.sqrt(light * self._shading[..., None] * gains.astype(np.float32))
        if self._flaws.noise:
            rng = np.random.default_rng([self._seed, 0x401, frame])
            noise = rng.standard_normal(shown.shape, np.float32)
            shown += self._flaws.noise * np.sqrt(gains.mean()) * noise
        image = np.rint(shown).clip(0, 255).astype(np.uint8)
        return image if self._flaws.jpeg is None else _through_jpeg(image, self._flaws.jpeg)

    def gains(self, time: float) -> Float64[np.ndarray, "3"]:
        """Gains of red, green and blue at ``time`` seconds."""
        stops, balance = np.sin(2 * np.pi * time / _PERIODS + self._phases).mean(1)
        balance *= self._flaws.colour_drift
        gain = 2.0 ** (self._flaws.gain_drift * stops)
        return np.array([gain * (1 + balance), gain, gain * (1 - balance)])


def _lens_shading(camera: Camera, corner_loss: float) -> Float32[np.ndarray, "h w"]:
    """Fraction of the light that arrives; it falls with the squared distance from the middle."""
    x = (np.arange(camera.width) - camera.cx) / camera.fx
    y = (np.arange(camera.height) - camera.cy) / camera.fy
    square = x[None] ** 2 + y[:, None] ** 2
    return (1 - corner_loss * square / square.max()).astype(np.float32)


def _through_jpeg(image: UInt8[np.ndarray, "h w 3"], quality: int) -> UInt8[np.ndarray, "h w 3"]:
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    stored = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    read = cv2.imdecode(stored, cv2.IMREAD_COLOR)
    assert read is not None
    return cv2.cvtColor(read, cv2.COLOR_BGR2RGB).astype(np.uint8)


@dataclass(frozen=True)
class DepthSensor:
    """A sensor of inverse depth with noise, steps, ragged edges and holes like a first Kinect's."""

    deviation: float = 0.0015
    """Standard deviation of inverse depth, per metre: the error of depth grows with its square."""
    step: float = 0.0028
    """Difference of inverse depth from one level to the next, per metre."""
    lateral: float = 0.7
    """Standard deviation of the pixel at which a depth is measured, pixels."""
    near: float = 0.4
    far: float = 5.0
    """Range of depths that are measured, metres."""
    grazing: float = 80.0
    """Largest angle between a ray and a surface's normal that is measured, degrees."""
    lost_at_edges: float = 0.5
    """Fraction of the pixels at a step of depth that are holes."""

    def measure(
        self, depth: Float32[np.ndarray, "h w"], focal: float, seed: int, frame: int
    ) -> Float32[np.ndarray, "h w"]:
        """Measured depth of exact depth z, in metres; 0 where there is none.

        ``focal`` in pixels. The same frame of the same seed has the same noise.
        """
        rng = np.random.default_rng([seed, 0xDE9, frame])
        height, width = depth.shape
        v, u = np.mgrid[:height, :width].astype(np.float32)
        jitter = self.lateral * rng.standard_normal((2, height, width), np.float32)
        seen = cv2.remap(
            depth, u + jitter[0], v + jitter[1], cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE
        )
        inverse = _inverse(seen)
        noisy = inverse + self.deviation * rng.standard_normal(inverse.shape, np.float32)
        noisy = np.maximum(np.rint(noisy / self.step) * self.step, self.step)
        lost = rng.random(inverse.shape, np.float32)
        hole = (seen < self.near) | (seen > self.far)
        hole |= _steps(depth) & (lost < self.lost_at_edges)
        hole |= _slant(depth, focal) > np.radians(self.grazing)
        return np.where(hole, 0, 1 / noisy).astype(np.float32)


def _inverse(depth: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Inverse depth, 0 where there is none."""
    return np.where(depth > 0, 1 / np.where(depth > 0, depth, 1), 0).astype(np.float32)


def _steps(depth: Float32[np.ndarray, "h w"]) -> np.ndarray:
    """Pixels at a step of depth of more than 5 %."""
    return cv2.dilate(depth, _CLOSED) > 1.05 * cv2.erode(depth, _CLOSED)


def _slant(depth: Float32[np.ndarray, "h w"], focal: float) -> Float32[np.ndarray, "h w"]:
    """Angle between optical axis and normal, radians, from the change of inverse depth."""
    d = _inverse(depth)
    across = cv2.Sobel(d, cv2.CV_32F, 1, 0, ksize=1) / 2
    down = cv2.Sobel(d, cv2.CV_32F, 0, 1, ksize=1) / 2
    tangent = focal * np.hypot(across, down) / np.maximum(d, np.float32(1e-6))
    return np.where(_steps(depth), 0, np.arctan(tangent))
