"""COLMAP: a sparse model beside its images, also as ScanNet++ ships it for the iPhone.

The layouts of cameras, images and points3D, as text or binary, are those of
https://colmap.github.io/format.html. Two-dimensional keypoints are skipped: only the
images that see each point are kept.
"""

import re
import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float64

from geogs.errors import InputError
from geogs.geometry.lie import quaternion_to_matrix
from geogs.guard.documents import first_file, read_bytes, read_text
from geogs.io.pose_files import FRAMES_PER_SECOND
from geogs.io.sources.account import Account, named
from geogs.io.sources.calibration_files import COLMAP_MODELS, calibration_from_colmap
from geogs.io.sources.formats.image_files import natural_key
from geogs.io.sources.named_files import IMAGE_FOLDERS, NamedFiles, elsewhere, unlisted
from geogs.io.sources.posed.posed_set import PosedFile, PosedSet, SparsePoints, renumbered
from geogs.io.sources.posed.stored_pictures import of_stored_pixels

_MODEL_FOLDERS = ("", "sparse", "colmap/sparse", "colmap", "iphone/colmap")
"""Folders of a model in a project, or of several in folders called 0, 1, ..."""
_PROJECT_FOLDERS = re.compile(
    r"sparse|colmap|\d+|iphone|dslr_calibration_undistorted|dslr_calibration_jpg"
)
_TABLES = ("cameras", "images")
_KEYPOINTS = re.compile(r"(?:[-+.\deE\s]++|nan|inf)++")
Row = TypeVar("Row")
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
    return any(_has_tables(folder, end) for end in (".bin", ".txt"))


def _has_tables(folder: Path, end: str) -> bool:
    return all((folder / f"{table}{end}").is_file() for table in _TABLES)


def read_model(folder: Path) -> SparseModel:
    """Read the model in ``folder``, binary if it has both forms.

    Raises:
        InputError: a file is missing, cut off or of another format.
    """
    binary = _has_tables(folder, ".bin")
    path = folder
    try:
        path = folder / f"cameras{'.bin' if binary else '.txt'}"
        cameras = _by_number(_binary_cameras(path) if binary else _text_cameras(path))
        path = path.with_stem("images")
        images = _by_number(_binary_images(path) if binary else _text_images(path))
        path = path.with_stem("points3D")
        rows = _binary_points(path) if binary else _text_points(path)
        points = _collected(rows) if path.is_file() else None
    except (struct.error, ValueError, IndexError, ArithmeticError) as error:
        said = str(error)  # a number parser's message would quote the file
        why = f" ({said})" if isinstance(error, _WrongModel) else ""
        raise InputError(
            f"{path} is cut off or no file of a COLMAP model{why}; copy it again."
        ) from None
    return SparseModel(cameras, images, points)


def _collected(points: Iterator[tuple[list[float], list[int]]]) -> SparsePoints:
    positions = []
    seen_point = []
    seen_image = []
    for index, (position, images) in enumerate(points):
        positions.append(position)
        seen_point += [index] * len(images)
        seen_image += images
    return SparsePoints(
        np.array(positions, dtype=np.float64).reshape(-1, 3),
        np.array(seen_point, dtype=np.int64),
        np.array(seen_image, dtype=np.int64),
    )


def _by_number(rows: Iterable[tuple[int, Row]]) -> dict[int, Row]:
    found: dict[int, Row] = {}
    for number, row in rows:
        if found.setdefault(number, row) != row:
            raise _WrongModel(f"two rows with the number {number}")
    return found


def _lines(path: Path) -> Iterator[str]:
    """The lines of a table without comments, and without empty ones, which mean no keypoints."""
    lines = (line.strip() for line in read_text(path).split("\n"))
    return (line for line in lines if line and line[0] != "#")


def _text_cameras(path: Path) -> Iterator[tuple[int, ModelCamera]]:
    for line in _lines(path):
        number, model, width, height, *parameters = line.split()
        values = tuple(float(word) for word in parameters)
        if model in COLMAP_MODELS and len(values) != len(COLMAP_MODELS[model]):
            raise _WrongModel(f"{len(values)} parameters of a {model} camera")
        yield int(number), ModelCamera(model, int(width), int(height), values)


def _text_images(path: Path) -> Iterator[tuple[int, ModelImage]]:
    """Images by the rows that have a name; rows of keypoints, which scripts may leave out, are
    triples of numbers."""
    for line in _lines(path):
        if _KEYPOINTS.fullmatch(line) and len(line.split()) % 3 == 0:
            continue
        words = line.split(maxsplit=9)
        if len(words) != 10:
            raise _WrongModel(f"{len(words)} columns in the row of an image, not 10")
        w, x, y, z, tx, ty, tz = (float(word) for word in words[1:8])
        yield int(words[0]), ModelImage(words[9], int(words[8]), (w, x, y, z), (tx, ty, tz))


def _text_points(path: Path) -> Iterator[tuple[list[float], list[int]]]:
    for words in map(str.split, _lines(path)):
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


def _binary_cameras(path: Path) -> Iterator[tuple[int, ModelCamera]]:
    data = _Bytes(path)
    for _ in range(data.count()):
        number, model, width, height = data.take("IiQQ")
        if not 0 <= model < len(COLMAP_MODELS):
            raise _WrongModel(f"camera model number {model} is unknown here")
        name, parameters = list(COLMAP_MODELS.items())[model]
        yield number, ModelCamera(name, width, height, data.take(f"{len(parameters)}d"))


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
        track = data.take(f"{2 * data.count()}I")
        yield [x, y, z], list(track[::2])  # its images; the others are keypoints


def find_model(folder: Path) -> Path | None:
    """The folder of the model in a project, the one of most images; none where there is none."""
    return next(iter(_models(folder)), None)


def _models(folder: Path) -> dict[Path, int]:
    """Folders of the models of a project, each with its number of images, the largest first; a
    single one is not counted."""
    for name in _MODEL_FOLDERS:
        place = folder / name
        own = [place] if is_model(place) else []
        if own and not name:
            return {place: 0}  # given itself
        numbered = (p for p in place.glob("*") if p.name.isdecimal() and is_model(p))
        places = [*sorted(numbered, key=lambda p: int(p.name)), *own]
        if places:
            counts = {p: _count(p) if len(places) > 1 else 0 for p in places}
            return dict(sorted(counts.items(), key=lambda pair: -pair[1]))
    return {}


def _count(place: Path) -> int:
    """Number of images of a model; 0 where it is damaged."""
    try:
        if _has_tables(place, ".bin"):
            return _Bytes(place / "images.bin").count()
        return sum(1 for _ in _text_images(place / "images.txt"))
    except (InputError, struct.error, ValueError):
        return 0


def open_colmap(folder: Path, images: Path | None = None) -> PosedSet:
    """Read the model in a project folder (or given itself), images in natural order of names.

    ``images`` is their folder; without it, they are searched for around the model.
    """
    places = _models(folder)
    if not places:
        raise InputError(f"{folder} holds no COLMAP model (cameras, images, points3D).")
    place = next(iter(places)).resolve()
    model = read_model(place)
    if not model.images:
        raise InputError(f"The COLMAP model {place} has no registered image.")
    numbers = sorted(model.images, key=lambda number: natural_key(model.images[number].name))
    names = [model.images[number].name for number in numbers]
    root = images or _image_folder(place, names)
    paths = NamedFiles(root).find(names)
    files = tuple(
        _file(model, model.images[number], root, path, place, k)
        for k, (number, path) in enumerate(zip(numbers, paths, strict=True))
    )
    others = [f"{other} ({count} images)" for other, count in places.items()][1:]
    said = (f"COLMAP models beside {place}: {named(others)}",) if others else ()
    account = Account(left=said) + elsewhere(names, paths)
    account += Account() if images else unlisted(paths)
    points = _points(model, numbers)
    return PosedSet("colmap", _project(place).name, files, points=points, account=account)


def pose_of(image: ModelImage) -> Float64[np.ndarray, "4 4"]:
    """World to camera; NaN where the quaternion is zero."""
    return pose_from(image.quaternion, image.translation)


def pose_from(wxyz: Sequence[float], translation: Sequence[float]) -> Float64[np.ndarray, "4 4"]:
    """The pose of a quaternion and a translation; NaN where the quaternion is zero."""
    quaternion = np.array(wxyz, dtype=np.float64)
    norm = np.linalg.norm(quaternion)
    T = np.eye(4)
    if not np.isfinite(norm) or norm == 0:
        return np.full((4, 4), np.nan)
    T[:3, :3] = quaternion_to_matrix(torch.from_numpy(quaternion / norm)).numpy()
    T[:3, 3] = translation
    return T


def _file(
    model: SparseModel, image: ModelImage, root: Path, path: Path | None, place: Path, index: int
) -> PosedFile:
    if image.camera not in model.cameras:
        raise InputError(
            f"{place}: image {image.name} names camera {image.camera}, which is not listed; is "
            f"the model complete?"
        )
    camera = model.cameras[image.camera]
    calibration = calibration_from_colmap(
        camera.model, camera.width, camera.height, camera.parameters, str(place)
    )
    path = path or root / image.name
    name = path.relative_to(root).as_posix() if path.is_relative_to(root) else image.name
    time = index / FRAMES_PER_SECOND
    mask = mask_beside(root, name)
    return of_stored_pixels(PosedFile(path, pose_of(image), calibration, mask, time))


def _project(place: Path) -> Path:
    """The folder of the project that a model folder belongs to."""
    above = (p for p in (place, *place.parents) if not _PROJECT_FOLDERS.fullmatch(p.name))
    return next(above, place)


def _image_folder(place: Path, names: list[str]) -> Path:
    """Folder of the images: the known one that has most of a sample of them."""
    project = _project(place)
    bases = dict.fromkeys((project, project / "iphone", place, place.parent, place.parent.parent))
    roots = [base / name for base in bases for name in (*IMAGE_FOLDERS, "")]
    sample = names[:: max(1, len(names) // 10)]
    found = [sum(path is not None for path in NamedFiles(root).find(sample)) for root in roots]
    if not any(found):
        raise InputError(
            f"The images of the COLMAP model {place}, such as {names[0]}, are not in "
            f"{project / 'images'}; put them there."
        )
    return roots[found.index(max(found))]


def mask_beside(root: Path, name: str) -> Path | None:
    """The mask of an image of a folder, in a folder of masks beside that, or none.

    COLMAP's own masks are called like the image with .png behind it.
    """
    if not Path(name).name:
        return None
    files = (f"{name}.png", Path(name).with_suffix(".png"))
    folders = ("masks", "mask", "rgb_masks")
    return first_file(root.parent / folder / file for folder in folders for file in files)


def _points(model: SparseModel, numbers: list[int]) -> SparsePoints | None:
    points = model.points
    if points is None or len(points.positions) == 0:
        return None
    images = renumbered(points.seen_image, numbers)
    known = images >= 0
    return SparsePoints(points.positions, points.seen_point[known], images[known])
