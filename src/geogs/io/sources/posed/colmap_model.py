"""Read a COLMAP model: cameras, images and points3D, as text or binary.

The layouts are those of https://colmap.github.io/format.html. Two-dimensional keypoints are
skipped: what is kept of them is which images see each point.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from geogs.documents import read_bytes, read_text
from geogs.errors import InputError

_MODELS = (
    ("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8), ("FULL_OPENCV", 12), ("FOV", 5), ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5), ("THIN_PRISM_FISHEYE", 12), ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
)  # fmt: skip
"""Name and number of parameters by the number of the model in binary files."""

_TABLES = ("cameras", "images")
LARGEST_TABLE = 1 << 34
"""Bytes of a binary file."""


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
class ModelPoints:
    """Triangulated points with their tracks."""

    positions: Float64[np.ndarray, "n 3"]
    seen_point: Int64[np.ndarray, "m"]
    """Index of the point of observation k."""
    seen_image: Int64[np.ndarray, "m"]
    """Identifier of the image of observation k."""


@dataclass(frozen=True, slots=True)
class Model:
    """A reconstruction; cameras and images by their identifiers."""

    cameras: dict[int, ModelCamera]
    images: dict[int, ModelImage]
    points: ModelPoints | None


def is_model(folder: Path) -> bool:
    """Whether ``folder`` holds cameras and images of a model."""
    return any(all((folder / f"{t}{end}").is_file() for t in _TABLES) for end in (".bin", ".txt"))


def read_model(folder: Path) -> Model:
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
        said = str(error)  # by a parser of numbers: it would repeat what the file holds
        why = f" ({said})" if isinstance(error, _Wrong) else ""
        raise InputError(
            f"{path} is cut off or no file of a COLMAP model{why}; copy it again."
        ) from None
    return Model(cameras, images, points)


def _collected(points: Iterator[tuple[list[float], list[int]]]) -> ModelPoints:
    positions, seen_point, seen_image = [], [], []
    for index, (position, images) in enumerate(points):
        positions.append(position)
        seen_point += [index] * len(images)
        seen_image += images
    return ModelPoints(
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
                raise _Wrong(f"{len(values)} parameters of a {model} camera")
            yield int(number), ModelCamera(model, int(width), int(height), values)


def _text_images(path: Path) -> Iterator[tuple[int, ModelImage]]:
    lines = iter([line for line in read_text(path).splitlines() if not line.startswith("#")])
    for line in lines:
        words = line.split(maxsplit=9)
        if not words:
            continue
        if len(words) != 10:
            raise _Wrong(f"{len(words)} columns in the row of an image, not 10")
        w, x, y, z, *t = (float(word) for word in words[1:8])
        tx, ty, tz = t
        yield int(words[0]), ModelImage(words[9], int(words[8]), (w, x, y, z), (tx, ty, tz))
        next(lines, None)  # its keypoints


def _text_points(path: Path) -> Iterator[tuple[list[float], list[int]]]:
    for words in _rows(path):
        if words:
            yield [float(word) for word in words[1:4]], [int(word) for word in words[8::2]]


class _Wrong(ValueError):
    """What is wrong, in words of ours."""


class _Bytes:
    """Little-endian values one after the other."""

    def __init__(self, path: Path) -> None:
        self._data = read_bytes(path, LARGEST_TABLE)
        self._at = 0

    def take(self, layout: str) -> tuple:
        values = struct.unpack_from("<" + layout, self._data, self._at)
        self._at += struct.calcsize("<" + layout)
        return values

    def count(self) -> int:
        """A number of records; refuses one that cannot be, before memory is asked for it."""
        (count,) = self.take("Q")
        if count > len(self._data):
            raise _Wrong(f"{count} records")
        return count

    def text(self) -> str:
        end = self._data.index(b"\0", self._at)
        word = self._data[self._at : end].decode()
        self._at = end + 1
        return word

    def skip(self, size: int) -> None:
        self._at += size
        if self._at > len(self._data):
            raise _Wrong("end of file")

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
            raise _Wrong(f"camera model number {model} is unknown here")
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
