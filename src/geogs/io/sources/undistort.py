"""From the image as it came to the working image: resize, then straighten it."""

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8

from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.geometry.distortion import distorted_pixels
from geogs.io.sources.calibration import Calibration
from geogs.shutter.camera import RollingCamera


class Rectifier:
    """Makes working images: longer side at most ``long_edge`` pixels, straight lines straight.

    The focal length is enlarged just enough that no pixel looks outside the source image, so
    there are no black borders; ``camera`` is the exact pinhole of the result.
    """

    def __init__(self, calibration: Calibration, long_edge: int) -> None:
        source = calibration.camera()
        distortion = calibration.distortion if calibration.is_distorted else ()
        self._distortion = distortion
        enlarges = long_edge <= 0 or long_edge >= max(source.width, source.height)
        resized = source if enlarges else source.with_long_edge(long_edge)
        self.resized_camera = resized
        """The pinhole part of the resized image, before its lens distortion is removed."""
        self._size = (resized.width, resized.height)
        self._maps: tuple[np.ndarray, np.ndarray] | None = None
        self.zoom = 1.0
        """Factor on the focal length that removes black borders; the crop is 1 - 1 / zoom."""
        self.camera = resized
        """The pinhole camera of the working image."""
        if distortion:
            self.zoom = _zoom_without_borders(resized, distortion)
            self.camera = _zoomed(resized, self.zoom)
            self._maps = cv2.initUndistortRectifyMap(
                _matrix(resized), np.array(distortion, dtype=np.float64), None,
                _matrix(self.camera), self._size, cv2.CV_32FC1,
            )  # fmt: skip

    def __call__(self, image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
        """The working image of a source image."""
        return self.straightened(self.resized(image))

    def rolling_camera(self, lines: int, quarter_turns: int) -> RollingCamera:
        """The camera of resized images whose sensor has so many lines and was turned so often."""
        return RollingCamera(self.resized_camera, self._distortion, quarter_turns, lines)

    def resized(self, image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
        """A source image at working size, with its distortion."""
        if (image.shape[1], image.shape[0]) == self._size:
            return image
        return cv2.resize(image, self._size, interpolation=cv2.INTER_AREA)

    def straightened(
        self,
        image: UInt8[np.ndarray, "h w 3"],
        offsets: Float[np.ndarray, "h w 2"] | None = None,
    ) -> UInt8[np.ndarray, "h w 3"]:
        """The working image of a resized image.

        ``offsets`` say where in the resized image, relative to where the lens alone puts it, each
        pixel of the working image was seen; what was outside gets the colour of the border.
        """
        maps = self._maps
        if offsets is not None:
            u, v = self._lens_maps()
            maps = u + offsets[..., 0], v + offsets[..., 1]
        if maps is not None:
            image = cv2.remap(image, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        return np.ascontiguousarray(image)

    def _lens_maps(self) -> tuple[np.ndarray, np.ndarray]:
        if self._maps is not None:
            return self._maps
        v, u = np.mgrid[: self._size[1], : self._size[0]].astype(np.float32)
        return u, v


def _matrix(camera: Camera) -> Float[np.ndarray, "3 3"]:
    return camera.matrix().numpy()


def _zoomed(camera: Camera, zoom: float) -> Camera:
    return Camera(
        camera.fx * zoom, camera.fy * zoom, camera.cx, camera.cy, camera.width, camera.height
    )


def _zoom_without_borders(camera: Camera, distortion: Sequence[float]) -> float:
    """The smallest factor of at least one on the focal length that shows no outside, to 1e-4."""
    low, high = 1.0, 1.0
    while not _sees_only_source(_zoomed(camera, high), camera, distortion):
        low, high = high, high * 1.25
        if high > 8:
            raise InputError(
                "The distortion coefficients fold the image over itself; check their order "
                "(k1, k2, p1, p2, k3) and that they belong to this camera."
            )
    while high - low > 1e-4:
        middle = (low + high) / 2
        if _sees_only_source(_zoomed(camera, middle), camera, distortion):
            high = middle
        else:
            low = middle
    return high


def _sees_only_source(target: Camera, source: Camera, distortion: Sequence[float]) -> bool:
    """Whether the border of the undistorted image lies in the source, and before any fold."""
    rays = _border_rays(target)
    pixels = distorted_pixels(rays, source, distortion)
    inner = distorted_pixels(0.99 * rays, source, distortion)
    centre = np.array([source.cx, source.cy])
    grows = np.linalg.norm(pixels - centre, axis=1) > np.linalg.norm(inner - centre, axis=1)
    inside = (pixels >= -0.5) & (pixels <= (source.width - 0.5, source.height - 0.5))
    return bool(grows.all() and inside.all())


def _border_rays(camera: Camera) -> Float[np.ndarray, "n 2"]:
    """x/z, y/z of the outermost pixels."""
    rays = camera.rays(torch.float64).numpy()[..., :2]
    return np.concatenate([rays[0], rays[-1], rays[:, 0], rays[:, -1]])
