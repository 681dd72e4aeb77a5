"""A source of images with known poses: every image at working size in one pinhole camera."""

import copy
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.io.sources.account import Account, named
from geogs.io.sources.posed.one_camera import OneCamera
from geogs.io.sources.posed.posed_set import PosedSet, SparsePoints, without_invalid_poses
from geogs.io.sources.posed.stored_pictures import stored_size
from geogs.io.sources.reader import fingerprint_of, read_ahead, size_of
from geogs.io.sources.selection import Selection, selection_of
from geogs.io.sources.working_images import check_large_enough


@dataclass(frozen=True, slots=True)
class PosedImage:
    """One working image with its pose."""

    index: int
    """Its index in the source, from 0."""
    label: str
    """Its name in messages: the file."""
    timestamp: float
    """Seconds."""
    image: UInt8[np.ndarray, "h w 3"]
    """RGB, undistorted."""
    T_cw: Float64[np.ndarray, "4 4"]
    """World to camera, OpenCV axes."""
    mask: Bool[np.ndarray, "h w"] | None
    """Pixels to use; none where all are valid."""


class PosedSource:
    """Images with known poses, all in one pinhole camera; read on demand.

    ``len(source)``, ``source[i]`` and iteration (which reads ahead) give :class:`PosedImage`.
    """

    def __init__(self, posed: PosedSet, config: InputConfig, hold_out: int | None = None) -> None:
        """Every ``hold_out``-th of the selected images is left out."""
        chosen = selection_of(config, None)
        posed = _selected(without_invalid_poses(_present(posed)), chosen)
        left_out = held_out_places(len(posed.files), hold_out)
        self.held_out: list[int] = [chosen.start + chosen.stride * i for i in left_out]
        """Indices of the images left out, in the source with neither start nor stride, from 0."""
        if left_out:
            posed = posed.only(sorted(set(range(len(posed.files))) - set(left_out)))
        self._one_camera = OneCamera(posed.files, config)
        if unlike := self._one_camera.unlike():
            posed = _without_unlike(posed, unlike)
            self._one_camera = OneCamera(posed.files, config)
        self._config = config
        self._found = posed.account
        self._files = posed.files
        self.kind = posed.kind
        """The format: colmap, nerfstudio, dtu, replica, tum, 7scenes, scannet or photographs."""
        self.name = posed.name
        """Name of the scene."""
        self.scene_scale = posed.scene_scale
        """Unit of the world: metres, millimetres or arbitrary."""
        self.points: SparsePoints | None = posed.points
        """Sparse world points with the images that see them, if the format has any."""
        self.left_out: tuple[tuple[str, str], ...] = posed.left_out
        """Names of images that have no pose, each with the reason as a clause."""
        self.T_cw: Float64[np.ndarray, "n 4 4"] = np.stack([file.T_cw for file in posed.files])
        """World to camera of all images, OpenCV axes."""
        self.timestamps: Float64[np.ndarray, "n"] = np.array(
            [file.timestamp for file in posed.files], dtype=np.float64
        )
        """Seconds."""
        self.pose_error: dict[str, int | float] = {}
        """Agreement of poses and camera with matches between the images, once that was checked."""
        check_large_enough(self._one_camera.camera, posed.name)

    @property
    def camera(self) -> Camera:
        """The pinhole camera of every image."""
        return self._one_camera.camera

    @property
    def found(self) -> str:
        """The images, in words."""
        size = "x".join(map(str, stored_size(self._files[0].path) or ("?", "?")))
        return f"{self.name}, {self.length} images of {size} with poses ({self.kind})"

    @property
    def account(self) -> Account:
        """Findings beside the images: those used, and those not used with the reason."""
        return self._one_camera.account + self._found

    @property
    def intrinsics_origin(self) -> str:
        """Origin of the intrinsics."""
        return self._one_camera.calibration.origin

    @property
    def is_focal_guess(self) -> bool:
        """Whether the focal length is only assumed."""
        return self._one_camera.calibration.is_guess

    def with_focal(self, factor: float, deviation: float) -> "PosedSource":
        """The same images with the focal length times a factor, of a relative deviation."""
        assumed = self._one_camera.calibration
        fx = assumed.fx * factor
        origin = f"estimated from images and poses, standard deviation {fx * deviation:.1f}"
        found = replace(assumed, fx=fx, fy=assumed.fy * factor, is_guess=False, origin=origin)
        same = copy.copy(self)
        same._files = tuple(replace(file, calibration=found) for file in self._files)
        same._one_camera = OneCamera(same._files, replace(self._config, intrinsics="auto"))
        return same

    @property
    def length(self) -> int:
        """Number of images."""
        return len(self._files)

    def __len__(self) -> int:
        return self.length

    def fingerprint(self) -> str:
        """Sixteen digits that depend on the names and sizes of the images."""
        return fingerprint_of([file.path for file in self._files])

    def stored_bytes(self) -> list[int]:
        """Size of each image file; 0 where it is gone.

        Of images of the same scene by the same camera, a blurred one is smallest.
        """
        return [size_of(file.path) or 0 for file in self._files]

    def label(self, index: int) -> str:
        """Name of image ``index`` in messages."""
        return str(self._files[index].path)

    def __getitem__(self, index: int) -> PosedImage:
        """Read one image.

        Raises:
            IndexError: there is no such image.
            InputError: it cannot be read.
        """
        index = range(self.length)[index]
        file = self._files[index]
        image, mask = self._one_camera.read(index)
        return PosedImage(index, self.label(index), file.timestamp, image, file.T_cw, mask)

    def __iter__(self) -> Iterator[PosedImage]:
        """Yield all images; the next one is read while the present one is used."""
        return read_ahead(self[index] for index in range(self.length))


def held_out_places(count: int, every: int | None) -> range:
    """Indices of the held-out images of ``count``, every ``every``-th; empty if that is none.

    Raises:
        InputError: ``every`` is below 2, or fewer than two images would remain.
    """
    if every is None:
        return range(0)
    if every < 2:
        raise InputError(f"hold-out is {every}; it must be at least 2, or every image would go.")
    places = range(every // 2, count, every)
    if count - len(places) < 2:
        raise InputError(
            f"Of {count} images only {count - len(places)} would be left to reconstruct from; "
            "give more images or a larger --hold-out."
        )
    return places


def _present(posed: PosedSet) -> PosedSet:
    """The set without images that are missing or no pictures."""
    if not posed.files:
        raise InputError(f"{posed.name} ({posed.kind}) lists no images with poses.")
    kept = [i for i, file in enumerate(posed.files) if stored_size(file.path) is not None]
    missing = len(posed.files) - len(kept)
    if not kept:
        raise InputError(
            f"{posed.name}: none of its {missing} images can be read, such as "
            f"{posed.files[0].path}; put them there."
        )
    if not missing:
        return posed
    count = f"{missing} of {len(posed.files)} images"
    return posed.only(kept).left(f"{count}, which are missing or damaged")


def _without_unlike(posed: PosedSet, unlike: dict[int, str]) -> PosedSet:
    """The set without images by quite another camera than most."""
    kept = [k for k in range(len(posed.files)) if k not in unlike]
    if len(kept) < 2:
        raise InputError(
            f"{posed.name}: hardly two of its {len(posed.files)} images are by one camera; give "
            "images of one camera, or undistort and crop them to one."
        )
    cameras = named([*dict.fromkeys(unlike.values())])
    return posed.only(kept).left(
        f"{len(unlike)} of {len(posed.files)} images, taken with quite another camera than most "
        f"({cameras})"
    )


def _selected(posed: PosedSet, chosen: Selection) -> PosedSet:
    kept = range(len(posed.files))[chosen.start : chosen.stop : chosen.stride]
    if not kept:
        raise InputError(
            f"{posed.name}: images {chosen.start} to {chosen.stop} of its {len(posed.files)} "
            f"are none; choose others."
        )
    return posed if len(kept) == len(posed.files) else posed.only(kept)
