"""Depth as a triangulating sensor measures it: noise, steps, ragged edges, holes, a range."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32

_STREAM = 0xDE9
_CLOSED = np.ones((3, 3), np.uint8)


@dataclass(frozen=True)
class DepthSensor:
    """A sensor of inverse depth with the numbers of a first Kinect."""

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
        rng = np.random.default_rng([seed, _STREAM, frame])
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
