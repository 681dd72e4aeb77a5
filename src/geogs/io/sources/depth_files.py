"""Sensor depth: depth images beside the colour images, registered to their pixels."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32

from geogs.camera.depth_images import sampled
from geogs.geometry.camera import Camera
from geogs.io.pictures import decoded
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.undistort import Rectifier

INVALID = 65535
"""Value for unknown depth of some sensors, besides 0."""

LEAST_CONFIDENCE = 1
"""Least confidence of a phone's lidar (0 low, 1 medium, 2 high) at which a depth is taken."""
LONGEST = 32_000
"""Longest side, in pixels, that OpenCV can interpolate."""


@dataclass(frozen=True)
class DepthCamera:
    """A depth sensor at another position than the colour camera."""

    camera: Camera
    T_colour_depth: tuple[float, float, float]
    """Translation from its axes to those of the colour camera, which are parallel; metres."""


@runtime_checkable
class RecordedDepth(Protocol):
    """A depth map as stored."""

    sensor: DepthCamera | None
    """Depth camera; none where its pixels are those of the colour image, at any size."""

    def metres(self) -> Float32[np.ndarray, "h w"] | None:
        """The depth of its own pixels, 0 where unknown; None where it cannot be read."""
        ...


@dataclass(frozen=True)
class DepthUnit:
    """Unit of stored depths."""

    per_metre: float = 1000.0
    """Units per metre."""
    origin: str = ""
    """Who says so: a data set, a file, or the user."""
    is_stated: bool = False
    """Whether the user, a file or the app that wrote the depths states it; else it is assumed."""

    def __str__(self) -> str:
        """In words."""
        size = "1 m" if self.per_metre == 1 else f"1/{self.per_metre:g} m"
        return f"{size} a unit" + (f" ({self.origin})" if self.origin else "")


MILLIMETRES = DepthUnit(origin="usual")
"""Unit that most depth images have."""
PHONE = DepthUnit(origin="the app's", is_stated=True)
"""Unit of the depth images of apps on phones."""


@dataclass(frozen=True)
class DepthFile:
    """A depth image as stored."""

    path: Path
    unit: DepthUnit = MILLIMETRES
    sensor: DepthCamera | None = None
    confidence: Path | None = None
    """Picture of the confidence of each pixel, see ``LEAST_CONFIDENCE``."""
    quarter_turns: int = 0
    """Clockwise quarter turns from the stored picture to the upright image."""

    def metres(self) -> Float32[np.ndarray, "h w"] | None:
        """The depth of the picture's own pixels, 0 where unknown; None where it cannot be read."""
        picture = decoded(self.path, cv2.IMREAD_UNCHANGED).picture
        if picture is None or picture.ndim != 2 or max(picture.shape) > LONGEST:
            return None
        metres = picture.astype(np.float32) / np.float32(self.unit.per_metre)
        unknown = ~np.isfinite(metres) | (metres < 0)
        if picture.dtype == np.uint16:
            unknown |= picture == INVALID
        if self.confidence is not None:
            trust = decoded(self.confidence, cv2.IMREAD_UNCHANGED).picture
            if trust is not None and trust.shape == metres.shape:
                unknown |= trust < LEAST_CONFIDENCE
        known = np.where(unknown, np.float32(0), metres)
        return np.ascontiguousarray(np.rot90(known, -self.quarter_turns))


def depth_beside(path: Path, confidence: Path | None = None) -> DepthFile | None:
    """Return an app's depth file in millimetres, with its confidence, where these files exist."""
    if not path.is_file():
        return None
    is_there = confidence is not None and confidence.is_file()
    return DepthFile(path, PHONE, confidence=confidence if is_there else None)


@dataclass(frozen=True)
class RectifiedDepth:
    """Depth at the pixels of a working image, computed on demand."""

    file: RecordedDepth
    colour: Calibration
    """Camera of the stored image."""
    rectifier: Rectifier
    """Rectifier that made the working image."""
    offsets: Float[np.ndarray, "h w 2"] | None = None
    """Pixel offsets of the rolling-shutter rectification."""

    def metres(self) -> Float32[np.ndarray, "h w"] | None:
        """Depth z in the working image's camera; 0 where unknown, None where it cannot be read."""
        depth = self.file.metres()
        if depth is None:
            return None
        if self.file.sensor is not None:
            depth = registered(depth, self.file.sensor, self.colour)
        resized = self.rectifier.resized_camera
        u, v = self.rectifier.source_pixels(self.offsets)
        height, width = depth.shape
        x = (u + 0.5) * (width / resized.width) - 0.5
        y = (v + 0.5) * (height / resized.height) - 0.5
        return sampled(depth, x.astype(np.float32), y.astype(np.float32))


def registered(
    depth: Float32[np.ndarray, "h w"], sensor: DepthCamera, colour: Calibration
) -> Float32[np.ndarray, "h2 w2"]:
    """Depth as the colour camera sees it, lens distortion included; the nearest surface wins.

    ``colour`` knows the size of its images.
    """
    own = sensor.camera.resized(depth.shape[1], depth.shape[0])
    rows, columns = np.nonzero(depth)
    z = depth[rows, columns].astype(np.float64)
    tx, ty, tz = sensor.T_colour_depth
    x = (columns - own.cx) / own.fx * z + tx
    y = (rows - own.cy) / own.fy * z + ty
    z = z + tz
    seen = colour.camera()
    z = np.where(z > 0, z, np.inf)
    pixels = seen.pixels(torch.from_numpy(np.stack([x / z, y / z], 1))).numpy()
    u, v = np.rint(pixels).T
    inside = (u >= 0) & (u < seen.width) & (v >= 0) & (v < seen.height) & np.isfinite(z)
    order = np.argsort(-z[inside], kind="stable")  # the last value written stays
    out = np.zeros((seen.height, seen.width), np.float32)
    out[v[inside].astype(int)[order], u[inside].astype(int)[order]] = z[inside][order]
    return out
