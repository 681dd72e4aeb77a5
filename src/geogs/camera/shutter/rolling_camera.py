"""A camera that reads its image line by line: its lens, and when each pixel is seen."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from geogs.camera.distortion import LensModel, distorted_pixels, undistorted_rays
from geogs.geometry.camera import Camera


@dataclass(frozen=True)
class RollingCamera:
    """The camera of upright images as they came, at any size, and the direction of its readout."""

    camera: Camera
    """The pinhole part."""
    distortion: tuple[float, ...] = ()
    """OpenCV's coefficients; empty for a pinhole."""
    lens: LensModel = field(default="polynomial", kw_only=True)
    """What they are the coefficients of."""
    quarter_turns: int = 0
    """Clockwise, from the images as the sensor read them to the upright ones."""
    lines: int | None = None
    """Lines that the sensor reads an image in; those of ``camera`` if none."""

    def line_times(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        """When pixels are seen, in readouts from the middle of the image.

        The first line of the sensor is seen at -1/2, the last at 1/2. The lines of images that
        were turned upright are columns, or come from the last to the first.
        """
        across = self.quarter_turns % 2 == 1
        size = self.camera.width if across else self.camera.height
        lines = size if self.lines is None else self.lines
        along = (pixels[:, 0 if across else 1] + 0.5) / size - 0.5
        # Turned clockwise once, what was the first line is the last column.
        sign = -1.0 if self.quarter_turns % 4 in (1, 2) else 1.0
        return sign * along * lines / max(lines - 1, 1)

    def rays(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
        """Unit vectors towards what pixels see."""
        plane = undistorted_rays(pixels, self.camera, self.distortion, self.lens)
        rays = np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def pixels(self, rays: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        """Where vectors of any length are seen; they point forward."""
        plane = rays[:, :2] / rays[:, 2:]
        return distorted_pixels(plane, self.camera, self.distortion, self.lens)
