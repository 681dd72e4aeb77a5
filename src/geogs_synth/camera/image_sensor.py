"""From the light on the sensor to the image: lens shading, gains, noise, JPEG."""

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

from geogs.geometry.camera import Camera
from geogs_synth.camera.flaws import Flaws

_PERIODS = np.array([1.7, 2.9, 5.3])
"""Periods of the waves that the automatic exposure and white balance follow, seconds."""
_DRIFT_STREAM, _NOISE_STREAM = 0xD1F, 0x401


class Sensor:
    """Makes images of light; the same frame of the same seed has the same noise."""

    def __init__(self, flaws: Flaws, camera: Camera, seed: int = 0) -> None:
        self._flaws = flaws
        self._seed = seed
        self._shading = _lens_shading(camera, flaws.vignetting)
        rng = np.random.default_rng([seed, _DRIFT_STREAM])
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
            rng = np.random.default_rng([self._seed, _NOISE_STREAM, frame])
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
