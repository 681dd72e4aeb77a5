"""Make working images of stored ones: resize, then undistort."""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from geogs.camera.distortion import RESAMPLING, LensModel, distorted_pixels, lens_maps
from geogs.camera.shutter.rolling_camera import RollingCamera
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.io.sources.calibration import Calibration

FieldOfView = float | Literal["auto"]
"""Degrees along the longer side of the working image."""
WHOLE = 0.95
"""Fraction of the image from which on a part counts as the whole."""
FISHEYE_VIEW = 90.0
"""Default field of view of a fisheye, degrees; a pinhole image would stretch more."""


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

    def of(self, camera: Camera) -> Camera:
        """The camera of the part, in whole pixels."""
        left, right = round(self.left * camera.width), round(self.right * camera.width)
        top, bottom = round(self.top * camera.height), round(self.bottom * camera.height)
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
    """Makes working images: longer side at most ``long_edge`` pixels, straight lines straight.

    The focal length is enlarged just enough that no pixel looks outside the source image, so
    there are no black borders, or such that the image has the requested field of view;
    ``camera`` is the exact pinhole of the result.
    """

    def __init__(
        self,
        calibration: Calibration,
        long_edge: int,
        field_of_view: FieldOfView = "auto",
        focal: float | None = None,
        window: Window | None = None,
    ) -> None:
        """``focal`` of the working image instead of a field of view: pixels that the lens did not
        see get the colour of the border. ``window``: the working image is only this part, and
        ``long_edge`` is that of the part.

        Raises InputError if the lens folds the image, or its view is too narrow.
        """
        source = calibration.camera()
        distortion = calibration.distortion if calibration.is_distorted else ()
        self._distortion = distortion
        self._lens = calibration.lens
        if window is not None:
            long_edge = round(long_edge * source.long_edge / window.of(source).long_edge)
        enlarges = long_edge <= 0 or long_edge >= source.long_edge
        resized = source if enlarges else source.with_long_edge(long_edge)
        self.resized_camera = resized
        """The pinhole part of the resized image, before its lens distortion is removed."""
        self.size = (resized.width, resized.height)
        """Width and height to which images are resized before their distortion is removed."""
        self._maps: tuple[np.ndarray, np.ndarray] | None = None
        self.zoom = 1.0
        """Factor on the focal length that removes black borders; the crop is 1 - 1 / zoom."""
        self.camera = resized
        """The pinhole camera of the working image."""
        bends = _Bending(resized, distortion, calibration.lens)
        if focal is not None:
            self.zoom = focal / resized.fx
        elif field_of_view != "auto":
            self.zoom = _zoom_to(field_of_view, bends)
        elif calibration.lens == "fisheye":
            self.zoom = max(_zoom_for(FISHEYE_VIEW, resized), bends.least_zoom())
        elif distortion:
            self.zoom = max(1.0, bends.least_zoom(1.0))
        if calibration.is_distorted or self.zoom != 1 or window is not None:
            zoomed = _zoomed(resized, self.zoom)
            self.camera = zoomed if window is None else window.of(zoomed)
            self._maps = lens_maps(self.camera, resized, distortion, calibration.lens)

    def __call__(self, image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
        """The working image of a source image."""
        return self.straightened(self.resized(image))

    def rolling_camera(self, lines: int, quarter_turns: int) -> RollingCamera:
        """The camera of resized images, for a sensor of ``lines`` and ``quarter_turns``."""
        return RollingCamera(
            self.resized_camera, self._distortion, quarter_turns, lines, lens=self._lens
        )

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
        """Pixel coordinates without distortion."""
        v, u = np.mgrid[: self.size[1], : self.size[0]].astype(np.float32)
        return u, v


@dataclass(frozen=True)
class _Bending:
    """Distortion of a source."""

    source: Camera
    distortion: Sequence[float]
    lens: LensModel

    def sees(self, zoom: float) -> bool:
        """Whether the border of the zoomed image lies in the source, inside any fold."""
        source = self.source
        rays = _border_rays(_zoomed(source, zoom))
        pixels = self._pixels(rays)
        inner = self._pixels(0.99 * rays)
        centre = np.array([source.cx, source.cy])
        grows = np.linalg.norm(pixels - centre, axis=1) > np.linalg.norm(inner - centre, axis=1)
        inside = (pixels >= -0.5) & (pixels <= (source.width - 0.5, source.height - 0.5))
        return bool(grows.all() and inside.all())

    def least_zoom(self, least: float = 0.05) -> float:
        """The smallest factor, at least ``least``, on the focal length without black borders.

        To 1e-4. Raises InputError where the lens folds the image.
        """
        low, high = least, least
        while not self.sees(high):
            low, high = high, high * 1.25
            if high > 8:
                raise InputError(
                    "The distortion coefficients fold the image over itself; check their order "
                    "(k1, k2, p1, p2, k3; of a fisheye k1, k2, k3, k4) and that they belong to "
                    "this camera."
                )
        while high - low > 1e-4:
            middle = (low + high) / 2
            if self.sees(middle):
                high = middle
            else:
                low = middle
        return high

    def _pixels(self, rays: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        return distorted_pixels(rays, self.source, self.distortion, self.lens)


def _zoom_to(degrees: float, bends: _Bending) -> float:
    """The factor for a field of view. Raises InputError if the lens sees less."""
    source = bends.source
    zoom = _zoom_for(degrees, source)
    if not bends.sees(zoom) and zoom < (least := bends.least_zoom()):
        most = 2 * math.degrees(math.atan(source.long_edge / 2 / (least * source.fx)))
        raise InputError(
            f"A straight image with a field of view of {degrees:g} degrees would show more than "
            f"the lens saw; give at most {math.floor(10 * most) / 10:g}."
        )
    return zoom


def _zoom_for(degrees: float, camera: Camera) -> float:
    """The factor on the focal length for a field of view along the longer side."""
    return camera.with_field_of_view(degrees).fx / camera.fx


def _zoomed(camera: Camera, zoom: float) -> Camera:
    return replace(camera, fx=camera.fx * zoom, fy=camera.fy * zoom)


def _border_rays(camera: Camera) -> Float[np.ndarray, "n 2"]:
    """x/z, y/z of the outermost pixels."""
    rays = camera.rays(torch.float64).numpy()[..., :2]
    return np.concatenate([rays[0], rays[-1], rays[:, 0], rays[:, -1]])
