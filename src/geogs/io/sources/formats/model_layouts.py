"""Photographs of a benchmark beside their COLMAP model, in metres: ScanNet++ and ETH3D.

ScanNet++ (https://kaldir.vc.in.tum.de/scannetpp/documentation): ``iphone/rgb`` at 60 images a
second with ``iphone/colmap``, and ``dslr/resized_images`` with ``dslr/colmap``. ETH3D
(https://www.eth3d.net/documentation): ``images/dslr_images_undistorted`` with
``dslr_calibration_undistorted``.
"""

import re
from dataclasses import replace
from pathlib import Path

from geogs.errors import InputError
from geogs.guard.documents import first_file, numbered
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.calibration_files import read_calibration
from geogs.io.sources.depth_files import depth_beside
from geogs.io.sources.formats.colmap import is_model, open_colmap
from geogs.io.sources.formats.image_files import (
    ImageFile,
    ImageList,
    Place,
    has_images,
    holds_pictures,
    images_in,
    in_order_of_time,
)
from geogs.io.sources.named_files import root_above
from geogs.io.sources.posed.posed_set import PosedSet

_MODELS = {
    "iphone/rgb": "iphone/colmap",
    "dslr/resized_images": "dslr/colmap",
    "dslr/original_images": "dslr/colmap",
    "images/dslr_images_undistorted": "dslr_calibration_undistorted",
    "images/dslr_images": "dslr_calibration_jpg",
}
"""Folders of images, with the folder of their model."""
SCANNETPP = tuple(name for name in _MODELS if name.startswith(("iphone", "dslr")))
ETH3D = tuple(name for name in _MODELS if name.startswith("images"))
_PHONE_CAMERA = "pose_intrinsic_imu.json"
_PHONE_FRAMES_PER_SECOND = 60.0
_FRAME = re.compile(r"frame_(\d{1,9})\.\w+")


def place_of_model(folder: Path) -> Place | None:
    """Images of the model in ``folder``; none where it is not the model of such a scene."""
    roots = ((root_above(folder, Path(model)), name) for name, model in _MODELS.items())
    places = (Place(root, root / name) for root, name in roots if root)
    return next((place for place in places if has_images(place.pictures)), None)


def open_photographs(place: Place) -> ImageList:
    """Read one folder of images in order of names; frames of the phone at their times."""
    kind = "eth3d" if holds_pictures(place.folder, ETH3D) else "scannetpp"
    name = f"{place.folder.resolve().name}-{place.pictures.name}"
    return ImageList(kind, name, _files(place), _camera(place))


def open_posed_photographs(place: Place) -> PosedSet:
    """Read one folder of images with the poses of its model; the world is in metres."""
    model = _model(place)
    if not is_model(model):
        raise InputError(f"{place.folder} holds no true poses: {model} with its model is missing.")
    times = {file.path: file.timestamp for file in _files(place)}
    posed = open_colmap(model, place.pictures)
    there = posed.only([k for k, file in enumerate(posed.files) if file.path in times])
    if not there.files:
        raise InputError(f"{place.pictures} holds none of the images of {model}.")
    files = tuple(replace(file, timestamp=times[file.path]) for file in there.files)
    return replace(there, files=files, scene_scale="metres")


def _model(place: Place) -> Path:
    return place.folder / _MODELS[place.pictures.relative_to(place.folder).as_posix()]


def _files(place: Place) -> list[ImageFile]:
    paths = images_in(place.pictures)
    frames = numbered(paths, _FRAME)
    if len(frames) < len(paths):
        return in_order_of_time(paths)
    depths = place.pictures.parent / "depth"
    return [
        ImageFile(path, k / _PHONE_FRAMES_PER_SECOND, depth_beside(depths / f"{path.stem}.png"))
        for k, path in frames
    ]


def _camera(place: Place) -> Calibration | None:
    file = first_file((_model(place) / "cameras.txt", place.pictures.parent / _PHONE_CAMERA))
    return None if file is None else read_calibration(file)
