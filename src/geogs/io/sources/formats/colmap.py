"""COLMAP: a sparse model beside its images, also as ScanNet++ ships it for the iPhone.

The layouts of cameras, images and points3D, as text or binary, are those of
https://colmap.github.io/format.html. Two-dimensional keypoints are skipped: only the
images that see each point are kept.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64, Int64

from geogs.documents import read_bytes, read_text
from geogs.errors import InputError
from geogs.geometry.lie import quaternion_to_matrix
from geogs.io.pose_files import FRAMES_PER_SECOND
from geogs.io.sources.calibration_files import calibration_from_colmap
from geogs.io.sources.formats.image_files import natural_key
from geogs.io.sources.posed.posed_set import PosedFile, PosedSet, SparsePoints, renumbered

_MODEL_FOLDERS = ("", "0", "sparse/0", "sparse", "colmap/sparse/0", "colmap", "iphone/colmap")
_IMAGE_FOLDERS = (
    "images", "image", "rgb", "color", "frames", "input", "resized_images", "original_images", "",
)  # fmt: skip
_PROJECT_FOLDERS = (
    "sparse", "colmap", "0", "iphone", "dslr_calibration_undistorted", "dslr_calibration_jpg",
)  # fmt: skip
_MODELS = (
    ("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8), ("FULL_OPENCV", 12), ("FOV", 5), ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5), ("THIN_PRISM_FISHEYE", 12), ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
)  # fmt: skip
"""Name and number of parameters by the number of the model in binary files."""

_TABLES = ("cameras", "images")
LARGEST_TABLE = 1 << 34
"""Largest binary file in bytes."""


@dataclass(frozen=True, slots=True)
class ModelCamera:
    """A camera as COLMAP writes it; its pixel centres are at +1/2."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class ModelImage:
    """A registered image."""

    name: str
    camera: int
    """Identifier of its camera."""
    quaternion: tuple[float, float, float, float]
    """w, x, y, z of the rotation world to camera."""
    translation: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class SparseModel:
    """A reconstruction; cameras and images by their identifiers."""

    cameras: dict[int, ModelCamera]
    images: dict[int, ModelImage]
    points: SparsePoints | None
    """Sparse points; they index images by identifier."""


def is_model(folder: Path) -> bool:
    """Whether ``folder`` holds cameras and images of a model."""
    return any(all((folder / f"{t}{end}").is_file() for t in _TABLES) for end in (".bin", ".txt"))


def read_model(folder: Path) -> SparseModel:
    """Read the model in ``folder``, binary if it has both forms.

    Raises:
        InputError: a file is missing, cut off or of another format.
    """
    binary = all((folder / f"{table}.bin").is_file() for table in _TABLES)
    path = folder
    try:
        path = folder / ("cameras.bin" if binary else "cameras.txt")
        cameras = dict(_binary_cameras(path) if binary else _text_cameras(path))
        path = path.with_stem("images")
        images = dict(_binary_images(path) if binary else _text_images(path))
        path = path.with_stem("points3D")
        points = None
        if path.is_file():
            points = _collected(_binary_points(path) if binary else _text_points(path))
    except (struct.error, ValueError, IndexError, ArithmeticError) as error:
        said = str(error)  # a number parser's message would quote the file
        why = f" ({said})" if isinstance(error, _WrongModel) else ""
        raise InputError(
            f"{path} is cut off or no file of a COLMAP model{why}; copy it again."
        ) from None
    return SparseModel(cameras, images, points)


def _collected(points: Iterator[tuple[list[float], list[int]]]) -> SparsePoints:
    positions, seen_point, seen_image = [], [], []
    for index, (position, images) in enumerate(points):
        positions.append(position)
        seen_point += [index] * len(images)
        seen_image += images
    return SparsePoints(
        np.array(positions, dtype=np.float64).reshape(-1, 3),
        np.array(seen_point, dtype=np.int64),
        np.array(seen_image, dtype=np.int64),
    )


def _rows(path: Path) -> Iterator[list[str]]:
    """The words of each line without comments; empty lines included, since they mean no points."""
    for line in read_text(path).splitlines():
        if not line.startswith("#"):
            yield line.split()


def _text_cameras(path: Path) -> Iterator[tuple[int, ModelCamera]]:
    for words in _rows(path):
        if words:
            number, model, width, height, *parameters = words
            values = tuple(float(word) for word in parameters)
            if len(values) != dict(_MODELS).get(model, len(values)):
                raise _WrongModel(f"{len(values)} parameters of a {model} camera")
            yield int(number), ModelCamera(model, int(width), int(height), values)


def _text_images(path: Path) -> Iterator[tuple[int, ModelImage]]:
    lines = iter([line for line in read_text(path).splitlines() if not line.startswith("#")])
    for line in lines:
        words = line.split(maxsplit=9)
        if not words:
            continue
        if len(words) != 10:
            raise _WrongModel(f"{len(words)} columns in the row of an image, not 10")
        w, x, y, z, tx, ty, tz = (float(word) for word in words[1:8])
        yield int(words[0]), ModelImage(words[9], int(words[8]), (w, x, y, z), (tx, ty, tz))
        next(lines, None)  # its keypoints


def _text_points(path: Path) -> Iterator[tuple[list[float], list[int]]]:
    for words in _rows(path):
        if words:
            yield [float(word) for word in words[1:4]], [int(word) for word in words[8::2]]


class _WrongModel(ValueError):
    """An error with a message of our own."""


class _Bytes:
    """Little-endian values one after the other."""

    def __init__(self, path: Path) -> None:
        self._data = read_bytes(path, LARGEST_TABLE)
        self._at = 0

    def take(self, layout: str) -> tuple[Any, ...]:
        values = struct.unpack_from("<" + layout, self._data, self._at)
        self._at += struct.calcsize("<" + layout)
        return values

    def count(self) -> int:
        """Read a number of records; an impossible one is refused before memory is allocated."""
        (count,) = self.take("Q")
        if count > len(self._data):
            raise _WrongModel(f"{count} records")
        return count

    def text(self) -> str:
        end = self._data.index(b"\0", self._at)
        word = self._data[self._at : end].decode()
        self._at = end + 1
        return word

    def skip(self, size: int) -> None:
        self._at += size
        if self._at > len(self._data):
            raise _WrongModel("end of file")

    def array(self, count: int, columns: int) -> Int64[np.ndarray, "n k"]:
        """``count`` rows of 32-bit numbers."""
        start = self._at
        self.skip(4 * count * columns)
        values = np.frombuffer(self._data, "<u4", count * columns, start)
        return values.reshape(count, columns).astype(np.int64)


def _binary_cameras(path: Path) -> Iterator[tuple[int, ModelCamera]]:
    data = _Bytes(path)
    for _ in range(data.count()):
        number, model, width, height = data.take("IiQQ")
        if not 0 <= model < len(_MODELS):
            raise _WrongModel(f"camera model number {model} is unknown here")
        name, parameters = _MODELS[model]
        yield number, ModelCamera(name, width, height, data.take(f"{parameters}d"))


def _binary_images(path: Path) -> Iterator[tuple[int, ModelImage]]:
    data = _Bytes(path)
    for _ in range(data.count()):
        number, w, x, y, z, tx, ty, tz, camera = data.take("I7dI")
        yield number, ModelImage(data.text(), camera, (w, x, y, z), (tx, ty, tz))
        data.skip(24 * data.count())  # its keypoints: x, y and the point


def _binary_points(path: Path) -> Iterator[tuple[list[float], list[int]]]:
    data = _Bytes(path)
    for _ in range(data.count()):
        _, x, y, z = data.take("Q3d")
        data.skip(3 + 8)  # colour and error
        yield [x, y, z], data.array(data.count(), 2)[:, 0].tolist()


def find_model(folder: Path) -> Path | None:
    """The folder of the model in a project, or none."""
    places = (folder / name for name in _MODEL_FOLDERS)
    return next((place for place in places if is_model(place)), None)


def open_colmap(folder: Path, images: Path | None = None) -> PosedSet:
    """Read the model in a project folder (or given itself), images in natural order of names.

    ``images`` is their folder; without it, they are searched for around the model.
    """
    place = find_model(folder)
    if place is None:
        raise InputError(f"{folder} holds no COLMAP model (cameras, images, points3D).")
    place = place.resolve()
    model = read_model(place)
    if not model.images:
        raise InputError(f"The COLMAP model {place} has no registered image.")
    numbers = sorted(model.images, key=lambda number: natural_key(model.images[number].name))
    root = images or _image_folder(place, [model.images[number] for number in numbers])
    files = tuple(
        _file(model, model.images[number], root, place, k) for k, number in enumerate(numbers)
    )
    return PosedSet("colmap", _project(place).name, files, points=_points(model, numbers))


def pose_of(image: ModelImage) -> Float64[np.ndarray, "4 4"]:
    """World to camera; NaN where the quaternion is zero."""
    quaternion = np.array(image.quaternion, dtype=np.float64)
    T_cw = np.eye(4)
    T_cw[:3, 3] = image.translation
    norm = np.linalg.norm(quaternion)
    if not np.isfinite(norm) or norm == 0:
        T_cw[:3] = np.nan
    else:
        T_cw[:3, :3] = quaternion_to_matrix(torch.from_numpy(quaternion / norm)).numpy()
    return T_cw


def _file(model: SparseModel, image: ModelImage, root: Path, place: Path, index: int) -> PosedFile:
    if image.camera not in model.cameras:
        raise InputError(
            f"{place}: image {image.name} names camera {image.camera}, which is not listed; is "
            f"the model complete?"
        )
    camera = model.cameras[image.camera]
    calibration = calibration_from_colmap(
        camera.model, camera.width, camera.height, camera.parameters, str(place)
    )
    path = _image_path(root, image.name)
    time = index / FRAMES_PER_SECOND
    return PosedFile(path, pose_of(image), calibration, mask_beside(root, image.name), time)


def _project(place: Path) -> Path:
    """The folder of the project that a model folder belongs to."""
    while place.name in _PROJECT_FOLDERS and place.parent != place:
        place = place.parent
    return place


def _image_folder(place: Path, images: list[ModelImage]) -> Path:
    """Folder of the images: the known one that has most of a sample of them."""
    project = _project(place)
    bases = dict.fromkeys((project, project / "iphone", place, place.parent, place.parent.parent))
    roots = [base / name for base in bases for name in _IMAGE_FOLDERS]
    sample = images[:: max(1, len(images) // 10)]
    found = [sum(_image_path(root, image.name).is_file() for image in sample) for root in roots]
    if not any(found):
        raise InputError(
            f"The images of the COLMAP model {place}, such as {images[0].name}, are not in "
            f"{project / 'images'}; put them there."
        )
    return roots[found.index(max(found))]


def _image_path(root: Path, name: str) -> Path:
    """The file of an image; ScanNet++ puts ``video/`` before some names."""
    path, short = root / name, root / name.rsplit("/", 1)[-1]
    return short if short.is_file() and not path.is_file() else path


def mask_beside(root: Path, name: str) -> Path | None:
    """The mask of an image of a folder, in a folder of masks beside that, or none.

    COLMAP's own masks are called like the image with .png behind it.
    """
    if not Path(name).name:
        return None
    for folder in ("masks", "mask", "rgb_masks"):
        for file in (f"{name}.png", str(Path(name).with_suffix(".png"))):
            if (root.parent / folder / file).is_file():
                return root.parent / folder / file
    return None


def _points(model: SparseModel, numbers: list[int]) -> SparsePoints | None:
    points = model.points
    if points is None or len(points.positions) == 0:
        return None
    images = renumbered(points.seen_image, numbers)
    known = images >= 0
    return SparsePoints(points.positions, points.seen_point[known], images[known])
