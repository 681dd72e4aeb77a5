"""Positions of the pixels of a rectified image in the image of a rolling shutter."""

import cv2
import numpy as np
import torch
from jaxtyping import Float

from geogs.camera.shutter.angular_motion import AngularMotion, rotated
from geogs.camera.shutter.rolling_camera import RollingCamera
from geogs.camera.shutter.shutter import Shutter
from geogs.geometry.camera import Camera
from geogs.types import SeenRows

CELL = 8
"""Pixels between two nodes; offsets are interpolated between them."""


def node_count(pixels: int) -> int:
    """Return the number of nodes along so many pixels."""
    return -(-pixels // CELL) + 2


class RowOffsets:
    """Offsets of the pixels of a rectified image in the rolling one, due to camera motion.

    The rectified image is that of a camera with a global shutter at the time of the middle row.
    The rolling camera sees a distant point at ray r where ``Exp(angles(t)) r`` projects through its
    lens, at the time t of the row that it projects to.
    """

    def __init__(self, rolling: RollingCamera, rectified: Camera) -> None:
        self._rolling = rolling
        self._rectified = rectified
        # One more cell on every side, so that all pixels lie between nodes.
        columns = (np.arange(node_count(rectified.width)) - 1) * CELL + (CELL - 1) / 2
        lines = (np.arange(node_count(rectified.height)) - 1) * CELL + (CELL - 1) / 2
        self._shape = (len(lines), len(columns))
        u, v = (x.ravel() for x in np.meshgrid(columns, lines))
        self._pixels = np.stack([u, v], axis=1)
        plane = rectified.plane(torch.from_numpy(self._pixels)).numpy()
        self._rays = np.concatenate([plane, np.ones_like(plane[:, :1])], axis=1)
        self._still = rolling.pixels(self._rays)

    def nodes(self, motion: AngularMotion, readout: float) -> Float[np.ndarray, "n 2"]:
        """Return offsets in pixels of the rolling image at the nodes, row by row.

        Args:
            motion: of the camera, at this image.
            readout: seconds from the first to the last row.
        """
        pixels = self._still
        velocity = None
        if motion.parallax is not None:
            velocity = self._sampled(motion.parallax)
            # The part due to the rate's change within a readout is not parallax.
            error = abs(readout) * np.linalg.norm(motion.acceleration)
            square = (velocity**2).sum(1, keepdims=True)
            velocity *= square / np.maximum(square + error**2, 1e-12)
        for _ in range(3):  # fixed point of row and time: an error shrinks some 50 times a round
            times = readout * self._rolling.line_times(pixels)
            rays = rotated(self._rays, motion.angles(times))
            if velocity is not None:
                rays[:, :2] += times[:, None] * velocity * rays[:, 2:]
            pixels = self._rolling.pixels(rays)
        return pixels - self._still

    def _sampled(self, field: Float[np.ndarray, "gh gw 2"]) -> Float[np.ndarray, "n 2"]:
        """Interpolate a field over the cells of the image at the nodes."""
        lines, columns = field.shape[:2]
        camera = self._rolling.camera
        size = np.array([camera.width, camera.height]) / [columns, lines]
        cells = ((self._still + 0.5) / size - 0.5).astype(np.float32)
        values = cv2.remap(
            field.astype(np.float32),
            cells[:, None, :1],
            cells[:, None, 1:],
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        return values[:, 0].astype(np.float64)

    def dense(self, nodes: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "h w 2"]:
        """Interpolate the offsets at the nodes at every pixel of the rectified image."""
        width, height = self._rectified.width, self._rectified.height
        size = (CELL * self._shape[1], CELL * self._shape[0])
        laid = nodes.astype(np.float32).reshape(*self._shape, 2)
        dense = cv2.resize(laid, size, interpolation=cv2.INTER_LINEAR)
        return dense[CELL : CELL + height, CELL : CELL + width]

    def seen(self, nodes: Float[np.ndarray, "n 2"], shutter: Shutter) -> SeenRows:
        """Return offsets and times of the pixels of an image rectified with these offsets.

        Args:
            nodes: offsets in pixels of the rolling image at the nodes.
            shutter: their shutter.
        """
        pixels = self._still + nodes
        plane = self._rolling.camera.plane(torch.from_numpy(pixels))
        offset = self._rectified.pixels(plane).numpy() - self._pixels
        seconds = shutter.readout * self._rolling.line_times(pixels)
        return SeenRows(
            torch.from_numpy(offset.reshape(*self._shape, 2)).half(),
            torch.from_numpy(seconds.reshape(self._shape)).half(),
            abs(shutter.error / shutter.readout) if shutter.readout else 0.0,
        )
