"""COLMAP's database of cameras, pictures, features and verified matches.

Its pixels have their centres at one half.
"""

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geogs.io.sources.calibration import Calibration
from geogs.threads import worker_count
from geogs_photos.photo_features import PhotoFeatures
from geogs_photos.photo_pairs import Pairs
from geogs_photos.pycolmap_library import load_colmap

ROUND = 40
"""Number of pairs matched between two reports of progress."""


@dataclass(frozen=True, slots=True)
class SharedCamera:
    """A camera of some of the pictures."""

    calibration: Calibration
    """Initial calibration, for pictures as they are stored."""
    is_known: bool
    """Whether it is fixed."""


def known_cameras(cameras: Sequence[SharedCamera]) -> list[int]:
    """Numbers of the fixed cameras in the database."""
    return [place + 1 for place, camera in enumerate(cameras) if camera.is_known]


@dataclass(frozen=True, slots=True)
class Entry:
    """A picture in the database; its number there is its index plus one."""

    name: str
    camera: int
    """Index of its camera."""
    features: PhotoFeatures


def write_database(
    path: Path,
    cameras: Sequence[SharedCamera],
    entries: Sequence[Entry],
    pairs: Pairs,
    seed: int,
    progress: Callable[[float], None] = lambda fraction: None,
) -> np.ndarray:
    """Write cameras, pictures, features, and the matches that one motion of the camera explains.

    Cameras and pictures are numbered from 1. Returns the number of kept matches between any two
    pictures, a symmetric matrix.
    """
    colmap = load_colmap()
    with closing(colmap.Database.open(path)) as database:
        for place, camera in enumerate(cameras):
            database.write_camera(_camera(colmap, place + 1, camera), use_camera_id=True)
        for place, entry in enumerate(entries):
            image = colmap.Image(name=entry.name, camera_id=entry.camera + 1, image_id=place + 1)
            database.write_image(image, use_image_id=True)
            features = entry.features
            offset = np.array([0.5, 0.5, 0, 0], np.float32)
            database.write_keypoints(place + 1, features.keypoints + offset)
            kind = colmap.FeatureExtractorType.SIFT
            descriptors = colmap.FeatureDescriptors(type=kind, data=features.descriptors)
            database.write_descriptors(place + 1, descriptors)
    matching = colmap.FeatureMatchingOptions(use_gpu=False, num_threads=worker_count())
    verification = colmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    listed = path.with_suffix(".pairs.txt")
    for begin in range(0, len(pairs), ROUND):
        some = pairs[begin : begin + ROUND]
        lines = [f"{entries[i].name} {entries[j].name}" for i, j in some]
        listed.write_text("\n".join([*lines, ""]), encoding="utf-8")
        colmap.match_image_pairs(
            path,
            matching_options=matching,
            pairing_options=colmap.ImportedPairingOptions(match_list_path=listed),
            verification_options=verification,
            device=colmap.Device.cpu,
        )
        progress(min(1.0, (begin + ROUND) / len(pairs)))
    listed.unlink(missing_ok=True)
    count = len(entries)
    with closing(colmap.Database.open(path)) as database:
        numbers, matches = database.read_two_view_geometry_num_inliers()
    kept = np.zeros((count, count), np.int64)
    for number, inliers in zip(numbers, matches, strict=True):
        one, other = colmap.pair_id_to_image_pair(number)
        kept[one - 1, other - 1] = kept[other - 1, one - 1] = inliers
    return kept


def _camera(colmap: Any, number: int, shared: SharedCamera) -> Any:
    """Make COLMAP's camera: with all of OpenCV's terms if it is known, else one focal length and
    one radial term to begin with."""
    c = shared.calibration
    if not shared.is_known:
        camera = colmap.Camera.create_from_model_id(
            number, colmap.CameraModelId.SIMPLE_RADIAL, c.fx, c.width, c.height
        )
        camera.has_prior_focal_length = not c.is_guess
        return camera
    models = colmap.CameraModelId
    terms = [*c.distortion, *[0.0] * 8]
    camera = colmap.Camera(camera_id=number, width=c.width, height=c.height)
    if c.lens == "fisheye":
        camera.model = models.OPENCV_FISHEYE
        count = 4
    elif any(terms[4:8]):
        camera.model = models.FULL_OPENCV
        count = 8
    else:
        camera.model = models.OPENCV
        count = 4
    camera.params = [c.fx, c.fy, c.cx + 0.5, c.cy + 0.5, *terms[:count]]
    camera.has_prior_focal_length = True
    return camera
