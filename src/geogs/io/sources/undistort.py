"""Make working images of stored ones: resize, then undistort."""

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from geogs.camera.distortion import RESAMPLING, lens_maps
from geogs.camera.field_of_view import FieldOfView, straight_camera, zoomed
from geogs.camera.shutter.rolling_camera import RollingCamera
from geogs.geometry.camera import Camera
from geogs.io.sources.calibration import Calibration

WHOLE = 0.95
"""Fraction of the image from which on a part counts as the whole."""


def resized_to(
    size: tuple[int, int], image: UInt8[np.ndarray, "h w *c"]
) -> UInt8[np.ndarray, "h2 w2 *c"]:
    """Resize an image to a width and height; unchanged where it has these."""
    if image.shape[1::-1] == size:
        return image
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def mask_as_image(
    way: Callable[[UInt8[np.ndarray, "h w 3"]], UInt8[np.ndarray, "h2 w2 3"]],
    mask: Bool[np.ndarray, "h w"],
) -> Bool[np.ndarray, "h2 w2"]:
    """Resample a mask like an image."""
    grey = np.where(mask, np.uint8(255), np.uint8(0))
    return way(np.repeat(grey[..., None], 3, 2))[..., 0] > 127


@dataclass(frozen=True, slots=True)
class Window:
    """A part of an image, in fractions of its width and height."""

    left: float
    top: float
    right: float
    bottom: float

    def corner(self, camera: Camera) -> tuple[int, int]:
        """Column and row of its first pixel."""
        return round(self.left * camera.width), round(self.top * camera.height)

    def of(self, camera: Camera) -> Camera:
        """The camera of the part, in whole pixels."""
        left, top = self.corner(camera)
        right, bottom = round(self.right * camera.width), round(self.bottom * camera.height)
        return replace(
            camera, cx=camera.cx - left, cy=camera.cy - top, width=right - left, height=bottom - top
        )


def window_around(valid: Bool[np.ndarray, "h w"]) -> Window | None:
    """The part of the images that holds all valid pixels; none if that is nearly the whole."""
    rows = np.flatnonzero(valid.any(axis=1))
    columns = np.flatnonzero(valid.any(axis=0))
    if not len(rows) or len(rows) * len(columns) > WHOLE * valid.size:
        return None
    height, width = valid.shape
    return Window(
        columns[0] / width, rows[0] / height, (columns[-1] + 1) / width, (rows[-1] + 1) / height
    )


class Rectifier:
    """Makes working images: longer side at most ``long_edge`` pixels, and straight lines straight
    (:func:`~geogs.camera.field_of_view.straight_camera`), unless the lens is kept."""

    def __init__(
        self,
        calibration: Calibration,
        long_edge: int,
        field_of_view: FieldOfView = "auto",
        focal: float | None = None,
        window: Window | None = None,
        keeps_lens: bool = False,
    ) -> None:
        """``focal`` of the working image instead of a field of view: pixels that the lens did not
        see get the colour of the border. ``window``: the working image is only this part, and
        ``long_edge`` is that of the part. With ``keeps_lens`` images are only resized.

        Raises InputError if the lens folds the image, or its view is too narrow.
        """
        source = calibration.camera()
        if window is not None:
            long_edge = round(long_edge * source.long_edge / window.of(source).long_edge)
        enlarges = long_edge <= 0 or long_edge >= source.long_edge
        resized = source if enlarges else source.with_long_edge(long_edge)
        self.resized_camera = resized
        """The camera of the resized image, with its distortion."""
        self.size = (resized.width, resized.height)
        """Width and height to which images are resized before their distortion is removed."""
        if focal is not None:
            straight = zoomed(resized.pinhole, focal / resized.fx)
        else:
            straight = straight_camera(resized, field_of_view)
        self.zoom = straight.fx / resized.fx
        """Factor on the focal length that removes black borders; the crop is 1 - 1 / zoom."""
        seen = resized if keeps_lens else straight
        self.camera = straight if window is None else window.of(straight)
        """The pinhole camera of the straight image."""
        self.image_camera = seen if window is None else window.of(seen)
        """The camera of the working image: with ``keeps_lens`` that of the lens."""
        self._maps: tuple[np.ndarray, np.ndarray] | None = None
        if self.image_camera != resized:
            left, top = (0, 0) if window is None else window.corner(resized)
            u, v = self._pixels
            self._maps = (u + left, v + top) if keeps_lens else lens_maps(self.camera, resized)

    def __call__(self, image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
        """The working image of a source image."""
        return self.straightened(self.resized(image))

    def rolling_camera(self, lines: int, quarter_turns: int) -> RollingCamera:
        """The camera of resized images, for a sensor of ``lines`` and ``quarter_turns``."""
        return RollingCamera(self.resized_camera, quarter_turns, lines)

    def resized(self, image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
        """A source image at working size, with its distortion."""
        return resized_to(self.size, image)

    def straightened(
        self, image: UInt8[np.ndarray, "h w 3"], offsets: Float[np.ndarray, "h2 w2 2"] | None = None
    ) -> UInt8[np.ndarray, "h2 w2 3"]:
        """The working image of a resized image.

        ``offsets`` are added to the position in the resized image, by the lens alone, of each
        pixel of the working image; pixels from outside get the colour of the border.
        """
        maps = self._maps if offsets is None else self.source_pixels(offsets)
        if maps is not None:
            image = cv2.remap(image, *maps, RESAMPLING, borderMode=cv2.BORDER_REPLICATE)
        return np.ascontiguousarray(image)

    def source_pixels(
        self, offsets: Float[np.ndarray, "h w 2"] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Column and row of each pixel of the working image in the resized image."""
        u, v = self._maps or self._pixels
        return (u, v) if offsets is None else (u + offsets[..., 0], v + offsets[..., 1])

    @functools.cached_property
    def _pixels(self) -> tuple[np.ndarray, np.ndarray]:
        """Pixel coordinates of the working image."""
        camera = self.image_camera
        v, u = np.mgrid[: camera.height, : camera.width].astype(np.float32)
        return u, v
