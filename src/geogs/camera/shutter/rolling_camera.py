"""Rolling-shutter camera: its lens, and the time of each pixel."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from geogs.geometry.camera import Camera


@dataclass(frozen=True)
class RollingCamera:
    """Camera of upright images of any size, with its lens, and the direction of its readout."""

    camera: Camera
    quarter_turns: int = 0
    """Clockwise quarter turns from the sensor's images to the upright ones."""
    lines: int | None = None
    """Lines of the sensor's readout; those of ``camera`` if None."""

    def line_times(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        """Return the times of pixels, in readouts from the middle of the image.

        The first line of the sensor is at -1/2, the last at 1/2. In rotated images its lines are
        columns, or run from the last to the first.
        """
        across = self.quarter_turns % 2 == 1
        size = self.camera.width if across else self.camera.height
        lines = size if self.lines is None else self.lines
        along = (pixels[:, 0 if across else 1] + 0.5) / size - 0.5
        # After one clockwise turn the first line is the last column.
        sign = -1.0 if self.quarter_turns % 4 in (1, 2) else 1.0
        return sign * along * lines / max(lines - 1, 1)

    def rays(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
        """Return the viewing rays of pixels, as unit vectors."""
        plane = self.camera.plane(torch.from_numpy(pixels)).numpy()
        rays = np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def pixels(self, rays: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        """Project vectors of any length that point forward."""
        plane = rays[:, :2] / rays[:, 2:]
        return self.camera.pixels(torch.from_numpy(plane)).numpy()
