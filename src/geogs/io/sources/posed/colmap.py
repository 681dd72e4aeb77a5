"""COLMAP: a sparse model beside its images, also as ScanNet++ ships it for the iPhone."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64

from geogs.errors import InputError
from geogs.geometry.lie import quaternion_to_matrix
from geogs.io.poses import FRAMES_PER_SECOND
from geogs.io.sources.calibration_files import calibration_from_colmap
from geogs.io.sources.images import natural_key
from geogs.io.sources.posed.colmap_model import Model, ModelImage, is_model, read_model
from geogs.io.sources.posed.files import PosedFile, PosedSet, SparsePoints, renumbered

_MODEL_FOLDERS = ("", "0", "sparse/0", "sparse", "colmap/sparse/0", "colmap", "iphone/colmap")
_IMAGE_FOLDERS = ("images", "image", "rgb", "color", "frames", "input", "")
_PROJECT_FOLDERS = ("sparse", "colmap", "0", "iphone")


def find_model(folder: Path) -> Path | None:
    """The folder of the model in a project, or none."""
    places = (folder / name for name in _MODEL_FOLDERS)
    return next((place for place in places if is_model(place)), None)


def open_colmap(folder: Path, images: Path | None = None) -> PosedSet:
    """Read the model in a project folder (or given itself), images in natural order of names.

    ``images`` is where they lie; without it, they are looked for around the model.
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


def _file(model: Model, image: ModelImage, root: Path, place: Path, index: int) -> PosedFile:
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
    """Where the images lie: the known folder that has most of the first ones."""
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
    path = root / name
    return path if path.is_file() or "/" not in name else _or_without_folder(path, root, name)


def _or_without_folder(path: Path, root: Path, name: str) -> Path:
    short = root / name.rsplit("/", 1)[-1]
    return short if short.is_file() else path


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


def _points(model: Model, numbers: list[int]) -> SparsePoints | None:
    points = model.points
    if points is None or len(points.positions) == 0:
        return None
    images = renumbered(points.seen_image, numbers)
    known = images >= 0
    return SparsePoints(points.positions, points.seen_point[known], images[known])
