"""The noise model of a depth sensor, for inverse depth.

Triangulating sensors (structured light, stereo) measure a disparity, so that the error of inverse
depth is the same everywhere, that of depth grows with its square. There is a common relative error
(calibration, temperature), and a depth may belong to a pixel nearby, which matters on slanted
surfaces:

    sigma^2 = deviation^2 + (ratio d)^2 + (lateral |grad d|)^2 .

The common error is one of scale, which no comparison of depths shows; the ratio stands for its
variation over the image.

At edges a sensor averages both sides or shows the wrong one, and pixels around holes are wrong:
pixels next to either are dropped. After Khoshelham and Elberink, "Accuracy and
resolution of Kinect depth data", Sensors 2012, and Nguyen et al., "Modeling Kinect sensor noise",
3DIMPVT 2012.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from geogs.config import DepthSensorConfig

LATERAL = 0.5
"""Lateral error of a depth, pixels of the working image."""
EDGE = 0.04
"""Relative step of depth between neighbouring pixels that is an edge."""
_EVERYWHERE = np.ones((3, 3), np.uint8)
_STEPS = 4.0
"""Least step at an edge in standard deviations of the sensor."""
INDEPENDENT = 9.0
"""Effective number of independent measurements in 25 neighbouring pixels."""


@dataclass(frozen=True)
class SensorDepth:
    """Measured inverse depth."""

    inverse_depth: Float32[np.ndarray, "h w"]
    """Inverse depth per metre; 0 where unknown."""
    deviation: Float32[np.ndarray, "h w"]
    """Standard deviation of it; infinite where unknown."""

    def at_cells(self, offset: int, stride: int, height: int, width: int) -> "SensorDepth":
        """Means of the pixels around every ``stride``-th pixel from ``offset`` on.

        On a plane the mean is the pixel's own value without noise; the errors of neighbours are
        correlated, so that 25 of them count as ``INDEPENDENT``.
        """
        known = (self.inverse_depth > 0).astype(np.float32)
        count, total, worst = (
            cv2.boxFilter(m, -1, (5, 5), normalize=False, borderType=cv2.BORDER_CONSTANT)
            for m in (known, self.inverse_depth, np.where(known > 0, self.deviation, 0))
        )
        is_known = (known > 0) & (count > 12)
        divisor = np.maximum(count, 1)
        inverse = np.where(is_known, total / divisor, 0)
        independent = np.maximum(INDEPENDENT * count / 25, 1)
        deviation = np.where(is_known, worst / divisor / np.sqrt(independent), np.inf)
        rows = slice(offset, offset + stride * height, stride)
        columns = slice(offset, offset + stride * width, stride)
        return SensorDepth(
            np.ascontiguousarray(inverse[rows, columns], np.float32),
            np.ascontiguousarray(deviation[rows, columns], np.float32),
        )

    def resized(self, width: int, height: int) -> "SensorDepth":
        """Averages over the pixels of a smaller image; unknown where most of them are.

        The deviation is the pixels' own: their common error does not average out.
        """
        known = (self.inverse_depth > 0).astype(np.float32)
        fraction, inverse, deviation = (
            cv2.resize(m, (width, height), interpolation=cv2.INTER_AREA)
            for m in (known, self.inverse_depth, np.where(known > 0, self.deviation, 0))
        )
        is_known = fraction > 0.5
        divisor = np.where(is_known, fraction, 1)
        return SensorDepth(
            np.where(is_known, inverse / divisor, 0).astype(np.float32),
            np.where(is_known, deviation / divisor, np.inf).astype(np.float32),
        )

    def tensors(
        self, device: torch.device | str
    ) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
        """Inverse depth and its information 1 / sigma^2, 0 where unknown."""
        information = np.where(self.inverse_depth > 0, self.deviation, np.inf) ** -2.0
        return (
            torch.from_numpy(self.inverse_depth).to(device),
            torch.from_numpy(information.astype(np.float32)).to(device),
        )


def sensor_depth(metres: Float32[np.ndarray, "h w"], config: DepthSensorConfig) -> SensorDepth:
    """Inverse depth and its deviation from a depth image z, 0 where the sensor saw nothing."""
    known = (metres >= 0.1) & (metres <= 10.0)  # sensors measure hardly anything beyond
    z = np.where(known, metres, 1.0).astype(np.float32)
    d = np.where(known, 1 / z, 0).astype(np.float32)
    # Holes neither make a step nor a gradient: the pixels around stand for them.
    highest = cv2.dilate(d, _EVERYWHERE)
    lowest = cv2.erode(np.where(known, d, np.float32(1e6)), _EVERYWHERE)
    step = np.where(known, highest - lowest, 0)
    is_edge = step > 2 * np.maximum(EDGE * d, _STEPS * np.float32(config.deviation))
    bad = cv2.dilate((is_edge | ~known).astype(np.uint8), _EVERYWHERE) > 0
    gradient = np.hypot(_slope(d, known, 1), _slope(d, known, 0))
    ratio = np.float32(config.ratio)
    lateral = np.float32(LATERAL)
    variance = config.deviation**2 + (ratio * d) ** 2 + (lateral * gradient) ** 2
    return SensorDepth(
        np.where(bad, 0, d).astype(np.float32),
        np.where(bad, np.inf, np.sqrt(variance)).astype(np.float32),
    )


def _slope(
    d: Float32[np.ndarray, "h w"], known: np.ndarray, axis: int
) -> Float32[np.ndarray, "h w"]:
    """Change of inverse depth from pixel to pixel over five of them; 0 next to holes."""
    kernel = np.array([[-2, -1, 0, 1, 2]], np.float32) / 10
    kernel = kernel if axis == 1 else kernel.T
    whole = cv2.erode(known.astype(np.uint8), np.ones(kernel.shape, np.uint8)) > 0
    return np.where(whole, cv2.filter2D(d, -1, kernel), 0)
