"""Images of several cameras, resampled to one common pinhole camera."""

from collections import Counter
from collections.abc import Hashable, Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float64, UInt8

from geogs.camera.distortion import RESAMPLING, lens_maps
from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.io.pictures import read_mask
from geogs.io.sources.account import Account
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.known_intrinsics import resolve_intrinsics
from geogs.io.sources.posed.posed_set import PosedFile
from geogs.io.sources.posed.stored_pictures import read_picture, stored_size
from geogs.io.sources.tones import tones_of_files
from geogs.io.sources.undistort import Rectifier, mask_as_image, resized_to

SAME_CAMERA = 0.02
"""Largest difference of two cameras that count as one, in pixels of the working image."""
MAX_ZOOM = 1.5
"""Largest enlargement of an image that has fewer pixels per degree than the common camera."""
MIN_SHARED = 0.6
"""Least overlap of the fields of view of two cameras, as a fraction of the larger one."""
MAX_KEPT_MAPS = 8
"""Largest number of cameras for which resampling maps are cached; with more, none are."""


class OneCamera:
    """The common camera, that of most images, and the resampling of each image to it."""

    def __init__(self, files: Sequence[PosedFile], config: InputConfig) -> None:
        self._files = files
        self._sizes = [_size(file) for file in files]
        self._tones = tones_of_files([file.path for file in files])
        keys = [(file.calibration, size) for file, size in zip(files, self._sizes, strict=True)]
        cameras = {
            (known, size): resolve_intrinsics(config.intrinsics, known, *size)
            for known, size in dict.fromkeys(keys)
        }
        self._common = common_place(keys)
        first = cameras[keys[self._common]]
        rectifier = Rectifier(first, config.long_edge, config.working_field_of_view)
        self.camera: Camera = rectifier.camera
        """The pinhole camera of every image."""
        self.calibration = first
        """The calibration of most images as stored."""
        keeps_maps = len(cameras) <= MAX_KEPT_MAPS
        ways = {
            key: rectifier
            if camera == first
            else _way(camera, self.camera, rectifier.zoom, keeps_maps)
            for key, camera in cameras.items()
        }
        self._ways = [ways[key] for key in keys]

    def unlike(self) -> dict[int, str]:
        """Images whose cameras differ too much from the common one, with a description of these."""
        ways = enumerate(self._ways)
        return {k: w.description for k, w in ways if isinstance(w, Resampler) and w.is_unlike}

    @property
    def account(self) -> Account:
        """The camera, and what is lost of images by others."""
        cropped = sum(isinstance(way, Resampler) and way.shared < 0.9 for way in self._ways)
        of = f"{cropped} of {len(self._files)} images by other cameras"
        left = (f"the edges of {of}, which only they see",) if cropped else ()
        camera = Account((self.calibration.sentence,), left)
        return camera + self._tones.account + self.calibration.account

    def read(self, index: int) -> tuple[UInt8[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"] | None]:
        """Read image ``index`` in the common camera, and its mask, or none where all is valid.

        Raises:
            InputError: it cannot be read.
        """
        file = self._files[index]
        stored = self._sizes[index]
        way = self._ways[index]
        image = way(read_picture(file.path, stored, way.size, self._tones))
        mask = None
        if file.mask is not None:
            valid = read_mask(file.mask, stored[::-1], of_alpha=file.mask == file.path)
            mask = mask_as_image(way, valid)
        covered = way.covered() if isinstance(way, Resampler) else None
        if covered is not None:
            mask = covered if mask is None else mask & covered
        return image, mask


class Resampler:
    """Makes the image of ``target`` from that of another camera at the same pose.

    Both look along the same axes, so that pixels map by K_source D(K_target^-1 u) with the
    source's distortion D, whatever the scene.
    """

    def __init__(
        self, source: Calibration, target: Camera, zoom: float, keeps_maps: bool = False
    ) -> None:
        """With ``keeps_maps`` the resampling maps are cached, at 8 bytes a pixel."""
        camera = source.camera()
        self.shared = _shared_view(camera, target)
        """Overlap as a fraction of the larger field of view."""
        self.is_unlike = target.fx / camera.fx > MAX_ZOOM or self.shared < MIN_SHARED
        """Whether the cameras differ too much for resampling."""
        self.description = f"{camera.width}x{camera.height}, focal length {camera.fx:.0f}"
        # The source is first resized to about the target's scale, to avoid aliasing.
        scale = min(1.0, target.fx / zoom / camera.fx)
        size = (round(camera.width * scale), round(camera.height * scale))
        resized = camera.resized(max(size[0], 1), max(size[1], 1))
        self.size = (resized.width, resized.height)
        """Width and height to which images are resized before they are resampled."""
        self._resized = resized
        self._target = target
        self._keeps_maps = keeps_maps
        self._kept: tuple[np.ndarray, np.ndarray] | None = None

    def __call__(self, image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
        """The image of the target."""
        image = resized_to(self.size, image)
        return cv2.remap(image, *self._maps(), RESAMPLING, borderMode=cv2.BORDER_REPLICATE)

    def covered(self) -> Bool[np.ndarray, "h w"] | None:
        """Pixels of the target that the source sees; none where it sees all."""
        x, y = self._maps()
        width, height = self.size
        covered = (x >= -1) & (x <= width) & (y >= -1) & (y <= height)
        return None if covered.all() else covered

    def _maps(self) -> tuple[np.ndarray, np.ndarray]:
        """Column and row in the resized source of each pixel of the target."""
        if self._kept is not None:
            return self._kept
        maps = lens_maps(self._target, self._resized)
        if self._keeps_maps:
            self._kept = maps
        return maps


def common_place(keys: Sequence[Hashable]) -> int:
    """Index of the first image of the most frequent camera; on a tie, of the earlier one."""
    return keys.index(Counter(keys).most_common(1)[0][0])


def _way(
    camera: Calibration, target: Camera, zoom: float, keeps_maps: bool
) -> Resampler | Rectifier:
    """Resampling of a camera to the target; a plain rectifier where they are the same."""
    if not camera.is_distorted:
        rectifier = Rectifier(camera, target.long_edge)
        own = rectifier.camera
        is_same_size = (own.width, own.height) == (target.width, target.height)
        if is_same_size and np.abs(_corners(own, target)).max() < SAME_CAMERA:
            return rectifier
    return Resampler(camera, target, zoom, keeps_maps)


def _corners(camera: Camera, target: Camera) -> Float64[np.ndarray, "2 2"]:
    """Motion of two corners of the image from one camera to the other, in pixels."""
    corners = np.array([[0.0, 0.0], [target.width - 1.0, target.height - 1.0]])
    rays = (corners - (target.cx, target.cy)) / (target.fx, target.fy)
    return rays * (camera.fx, camera.fy) + (camera.cx, camera.cy) - corners


def _shared_view(one: Camera, other: Camera) -> float:
    """Overlap of two images on the plane z = 1, as a fraction of the larger area."""
    (low, high), (other_low, other_high) = _view(one), _view(other)
    shared = np.minimum(high, other_high) - np.maximum(low, other_low)
    area = max(np.prod(high - low), np.prod(other_high - other_low))
    return float(np.prod(shared.clip(0)) / area)


def _view(camera: Camera) -> tuple[Float64[np.ndarray, "2"], Float64[np.ndarray, "2"]]:
    """The corners of the image on the plane z = 1."""
    corners = np.array([[-0.5, -0.5], [camera.width - 0.5, camera.height - 0.5]])
    low, high = (corners - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    return low, high


def _size(file: PosedFile) -> tuple[int, int]:
    size = stored_size(file.path)
    if size is None:
        raise InputError(f"{file.path} is damaged; copy it again, or leave it out.")
    return size
