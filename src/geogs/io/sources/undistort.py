"""From the image as it came to the working image: resize, then remove the lens distortion."""

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8

from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.io.sources.calibration import Calibration


class Rectifier:
    """Makes working images: longer side at most ``long_edge`` pixels, straight lines straight.

    The focal length is enlarged just enough that no pixel looks outside the source image, so
    there are no black borders; ``camera`` is the exact pinhole of the result.
    """

    def __init__(self, calibration: Calibration, long_edge: int) -> None:
        source = calibration.camera()
        enlarges = long_edge <= 0 or long_edge >= max(source.width, source.height)
        resized = source if enlarges else source.with_long_edge(long_edge)
        self._size = (resized.width, resized.height)
        self._maps: tuple[np.ndarray, np.ndarray] | None = None
        self.zoom = 1.0
        """Factor on the focal length that removes black borders; the crop is 1 - 1 / zoom."""
        self.camera = resized
        """The pinhole camera of the working image."""
        if calibration.is_distorted:
            distortion = np.array(calibration.distortion, dtype=np.float64)
            self.zoom = _zoom_without_borders(resized, distortion)
            self.camera = _zoomed(resized, self.zoom)
            self._maps = cv2.initUndistortRectifyMap(
                _matrix(resized), distortion, None, _matrix(self.camera), self._size, cv2.CV_32FC1
            )

    def __call__(self, image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
        """The working image of a source image."""
        if (image.shape[1], image.shape[0]) != self._size:
            image = cv2.resize(image, self._size, interpolation=cv2.INTER_AREA)
        if self._maps is not None:
            image = cv2.remap(image, *self._maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        return np.ascontiguousarray(image)


def _matrix(camera: Camera) -> Float[np.ndarray, "3 3"]:
    return camera.matrix().numpy()


def _zoomed(camera: Camera, zoom: float) -> Camera:
    return Camera(
        camera.fx * zoom, camera.fy * zoom, camera.cx, camera.cy, camera.width, camera.height
    )


def _zoom_without_borders(camera: Camera, distortion: Float[np.ndarray, "k"]) -> float:
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


def _sees_only_source(target: Camera, source: Camera, distortion: Float[np.ndarray, "k"]) -> bool:
    """Whether the border of the undistorted image lies in the source, and before any fold."""
    rays = _border_rays(target)
    pixels = _distort(rays, source, distortion)
    inner = _distort(0.99 * rays, source, distortion)
    centre = np.array([source.cx, source.cy])
    grows = np.linalg.norm(pixels - centre, axis=1) > np.linalg.norm(inner - centre, axis=1)
    inside = (pixels >= -0.5) & (pixels <= (source.width - 0.5, source.height - 0.5))
    return bool(grows.all() and inside.all())


def _border_rays(camera: Camera) -> Float[np.ndarray, "n 2"]:
    """x/z, y/z of the outermost pixels."""
    rays = camera.rays(torch.float64).numpy()[..., :2]
    return np.concatenate([rays[0], rays[-1], rays[:, 0], rays[:, -1]])


def _distort(
    rays: Float[np.ndarray, "n 2"], camera: Camera, distortion: Float[np.ndarray, "k"]
) -> Float[np.ndarray, "n 2"]:
    points = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), _matrix(camera), distortion)
    return pixels[:, 0]
