"""Calibration files: JSON (geogs, Replica, nerfstudio, apps), COLMAP text, OpenCV/ROS YAML, KITTI,
numbers.

COLMAP and nerfstudio put the centre of the first pixel at (1/2, 1/2); their principal points are
moved by half a pixel to the convention used here.
"""

import logging
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from geogs.camera.distortion import LensModel
from geogs.errors import InputError
from geogs.guard.documents import (
    LARGEST_SETTINGS,
    UNUSABLE,
    read_json,
    read_text,
    whole_number,
    yaml_value,
)
from geogs.io.pictures import header_of
from geogs.io.sources.account import Account
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.camera_keys import (
    coefficients,
    focal_lengths,
    has_focal_length,
    lens_named,
    lens_of,
    of_frame,
    unused_keys,
)
from geogs.io.sources.data_set_cameras import (
    arkit_camera,
    is_kitti,
    kitti_camera,
    pinhole_of,
    scannetpp_camera,
)
from geogs.io.sources.named_files import NamedFiles

Numbers = Sequence[float]

COLMAP_MODELS: dict[str, list[str]] = {
    name: names.split()
    for name, names in {
        "SIMPLE_PINHOLE": "f cx cy",
        "PINHOLE": "fx fy cx cy",
        "SIMPLE_RADIAL": "f cx cy k1",
        "RADIAL": "f cx cy k1 k2",
        "OPENCV": "fx fy cx cy k1 k2 p1 p2",
        "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
        "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
        "FOV": "fx fy cx cy omega",
        "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
        "RADIAL_FISHEYE": "f cx cy k1 k2",
        "THIN_PRISM_FISHEYE": "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1",
        "RAD_TAN_THIN_PRISM_FISHEYE": "fx fy cx cy k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3",
        "SIMPLE_DIVISION": "f cx cy k",
        "DIVISION": "fx fy cx cy k",
        "SIMPLE_FISHEYE": "f cx cy",
        "FISHEYE": "fx fy cx cy",
        "EUCM": "fx fy cx cy alpha beta",
        "EQUIRECTANGULAR": "w h",
    }.items()
}
"""Parameters of COLMAP's cameras (https://colmap.github.io/cameras.html), in the order of their
numbers in binary files."""
FISHEYE = "fisheye"
"""Word before the numbers of a fisheye."""
_NUMBERS: dict[LensModel, tuple[tuple[int, ...], str]] = {
    "polynomial": ((4, 8, 9, 12), "fx,fy,cx,cy[,k1,k2,p1,p2[,k3[,k4,k5,k6]]]"),
    "fisheye": ((4, 8), "fisheye,fx,fy,cx,cy[,k1,k2,k3,k4]"),
}
"""How many numbers describe a camera of a lens, and which."""
_DISTORTIONS = (
    *("distortion", "distortion_coefficients", "distortion_coeffs", "dist_coeffs", "coeffs", "D"),
)
"""Keys of all coefficients together."""
_SIZES = ("image_width", "width", "w"), ("image_height", "height", "h")
KNOWN_KEYS = " ".join(
    (
        "fx fy cx cy ppx ppy K camera_matrix intrinsics resolution image_size is_guess origin",
        "width height image_width image_height",
        *_DISTORTIONS,
        # harmless: a result's, Replica's, RealSense's
        "scale camera source stream model first_pixel_centre shutter self_calibration",
        "focal_deviation k1_deviation k2_deviation",
        # EuRoC's and Kalibr's
        "T_BS T_cam_imu T_imu_cam T_cn_cnm1 cam_overlaps rostopic timeshift_cam_imu rate_hz",
        "comment sensor_type timeshift",
        # OpenCV's and ROS's
        "camera_name rectification_matrix projection_matrix calibration_time nframes nr_of_frames",
        "board_width board_height square_size marker_size flags avg_reprojection_error header R P",
        "per_view_reprojection_errors extrinsic_parameters image_points grid_points fps RGB bf",
        # Record3D's and Polycam's
        "poses initPose dw dh perFrameIntrinsicCoeffs frameTimestamps cameraType timestamp",
        " ".join(f"t_{row}{column}" for row in range(3) for column in range(4)),
        "blur_score neighbors center_depth angular_velocity manual_keyframe",
    )
)
"""Keys of a camera in JSON and YAML that are used, or matter nothing to it."""
KNOWN_TRANSFORMS = (
    "frames file_path transform_matrix mask_path applied_transform applied_scale "
    # harmless: of other images, of the scene's box, of a training, of the program that wrote it
    "depth_file_path depth_path normal_file_path ply_file_path depth_map_path aabb_scale aabb "
    "render_aabb scale offset up sharpness colmap_im_id rotation name id train_filenames "
    "val_filenames test_filenames orientation_override auto_scale_poses_override white_transparent "
    "black_transparent integer_depth_scale depth_unit_scale_factor enable_depth_loading "
    "enable_ray_loading fix_premult sharpen n_extra_learnable_dims importance_sampling envmap "
    "sharpness_discard_threshold has_mask"
)
"""Keys of ``transforms.json`` that are used, or matter nothing to cameras and poses."""
_COLMAP_ROW = re.compile(r"^\s*\d+\s+[A-Z][A-Z_]+\s+\d+\s+\d+\s", re.MULTILINE)
_RECORD3D, _SCANNETPP = "metadata", "pose_intrinsic_imu.json"
"""Names of files with cameras of Record3D and of ScanNet++'s phone."""

_log = logging.getLogger(__name__)


class NoFocalLengthError(InputError):
    """A list of images with poses that states no focal length."""


def read_calibration(path: Path) -> Calibration:
    """Read the camera in ``path``; the format follows from the name and the content.

    Raises:
        InputError: the file is missing, unreadable, of no known format, or of another lens.
    """
    suffix = path.suffix.lower()
    is_json = suffix == ".json" or path.name == _RECORD3D
    document, text = (read_json(path), "") if is_json else (None, read_text(path, LARGEST_SETTINGS))
    try:
        if is_json:
            return _from_json(document, path)
        if suffix in (".yaml", ".yml"):
            return calibration_from_document(camera_document(path), path)
        if _COLMAP_ROW.search(text):
            return _from_colmap(text, path)
        if is_kitti(text):
            return kitti_camera(path, None)
        return arkit_camera(path) if suffix == ".pincam" else _from_numbers(text, path)
    except UNUSABLE as error:
        # The missing entry, if that is the error; the file's content is never quoted.
        reason = f" (no entry {error})" if isinstance(error, KeyError) else ""
        raise InputError(
            f"{path} is no calibration that can be understood{reason}; "
            f"give fx fy cx cy [k1 k2 p1 p2 [k3]], or fisheye fx fy cx cy [k1 k2 k3 k4]."
        ) from None


def camera_document(path: Path, name: str = "cam0") -> dict[str, Any]:
    """The camera of a YAML file, or the one of a name in Kalibr's chain.

    Raises:
        InputError: it cannot be read.
        ValueError: it is no description of a camera.
    """
    # OpenCV writes a directive and a tag that plain YAML readers refuse.
    text = re.sub(
        r"^%YAML.*$|!!opencv-matrix", "", read_text(path, LARGEST_SETTINGS), flags=re.MULTILINE
    )
    document = yaml_value(text, str(path))
    if not isinstance(document, dict):
        raise ValueError
    camera: dict[str, Any] = document.get(name, document)
    return camera


def calibration_from_words(words: Sequence[str], origin: str) -> Calibration:
    """Build a calibration from numbers as words; ``fisheye`` may come first. Raises ValueError."""
    lens: LensModel = "fisheye" if words[:1] == [FISHEYE] else "polynomial"
    numbers = [float(word) for word in words[lens == "fisheye" :]]
    return calibration_from_numbers(numbers, origin, lens)


def calibration_from_numbers(
    numbers: Numbers, origin: str, lens: LensModel = "polynomial"
) -> Calibration:
    """Build a calibration from fx, fy, cx, cy in pixels and the coefficients of a lens.

    A negative fy is that of ICL-NUIM, whose y axis points up though its images are upright.
    """
    counts, order = _NUMBERS[lens]
    if len(numbers) not in counts:
        raise InputError(
            f"The intrinsics ({origin}) hold {len(numbers)} numbers; expected {order}."
        )
    fx, fy, cx, cy, *distortion = numbers
    if fy < 0 < fx:
        _log.info("fy (%s) is negative, of a y axis that points up; taken as positive.", origin)
        fy = -fy
    return Calibration(fx, fy, cx, cy, tuple(distortion), origin=origin, lens=lens)


def _from_json(document: Any, path: Path) -> Calibration:
    if path.name == _SCANNETPP:
        return scannetpp_camera(document, path)
    # "source" is the camera of the images as stored, in the intrinsics.json of a result.
    is_whole = "frames" in document or has_focal_length(document)
    parts = [document, document.get("camera"), document.get("source")]
    # A camera may also have its name there.
    entry = document if is_whole else [part for part in parts if isinstance(part, dict)][-1]
    is_transforms = is_whole or has_focal_length(entry)
    return (_from_transforms if is_transforms else calibration_from_document)(entry, path)


def _from_transforms(document: dict[str, Any], path: Path) -> Calibration:
    """The camera of the images of ``transforms.json``: the median one where they differ."""
    frames = document.get("frames") or [{}]
    entries = [of_frame(document, frame) for frame in frames]
    if not all(has_focal_length(entry) for entry in entries):
        lens_of(entries[0], path)
        raise NoFocalLengthError(
            f"{path} states no focal length (fl_x, x_fov or camera_angle_x); give numbers."
        )
    if "w" not in entries[0]:
        (first,) = NamedFiles(path.parent).find([frames[0].get("file_path", "")])
        header = None if first is None else header_of(first)
        size = dict(zip("wh", header[0], strict=True)) if header else {}
        entries = [size | entry for entry in entries]
    cameras = sorted((calibration_from_nerfstudio(e, path) for e in entries), key=lambda c: c.fx)
    kinds = {(camera.width, camera.height, camera.lens) for camera in cameras}
    if len(kinds) > 1:
        raise InputError(f"{path} holds {len(kinds)} different cameras; give a file with one.")
    middle = cameras[len(cameras) // 2]
    spread = cameras[-1].fx / cameras[0].fx - 1
    varies = (f"the median of focal lengths that vary by {spread:.1%}",) if spread > 1e-6 else ()
    return replace(
        middle, account=middle.account + account_of_transforms(document, path) + Account(varies)
    )


def calibration_from_nerfstudio(entry: dict[str, Any], path: Path) -> Calibration:
    """Translate the keys of ``transforms.json``; raises KeyError, TypeError or ValueError."""
    lens = lens_of(entry, path)
    fx, fy, key, account = focal_lengths(entry, path)
    cx = float(entry["cx"] if "cx" in entry else entry["w"] / 2) - 0.5
    cy = float(entry["cy"] if "cy" in entry else entry["h"] / 2) - 0.5
    width, height = (_optional_int(entry.get(edge)) for edge in "wh")
    origin = str(path) if key.startswith("fl") else f"{path}, {key}"
    account = Account() if lens == "fisheye" else account  # whose angles are not a pinhole's
    distortion = coefficients(entry, lens, path)
    found = Calibration(fx, fy, cx, cy, distortion, width, height, origin, lens=lens)
    return replace(found, account=account)


def account_of_transforms(document: dict[str, Any], path: Path) -> Account:
    """The keys of ``transforms.json`` that are not used and may matter."""
    return unused_keys([document, *document.get("frames", ())], KNOWN_TRANSFORMS, path)


def _from_colmap(text: str, path: Path) -> Calibration:
    lines = [line.split() for line in text.splitlines() if line.strip() and line.strip()[0] != "#"]
    cameras = {tuple(words[1:]) for words in lines}
    if len(cameras) != 1:
        raise InputError(f"{path} holds {len(cameras)} different cameras; give a file with one.")
    model, width, height, *words = next(iter(cameras))
    size = whole_number(width), whole_number(height)
    return calibration_from_colmap(model, *size, [float(word) for word in words], str(path))


def calibration_from_colmap(
    model: str, width: int, height: int, parameters: Numbers, origin: str
) -> Calibration:
    """Translate a camera of COLMAP (https://colmap.github.io/cameras.html).

    Raises:
        InputError: the camera model is not supported.
    """
    lens = lens_named(model or "other", origin)
    names = COLMAP_MODELS.get(model)
    if names is None:
        raise InputError(f"{origin}: {model} is no camera model of COLMAP; correct it.")
    if len(parameters) != len(names):
        raise InputError(
            f"{origin}: a {model} camera has {len(names)} parameters, not {len(parameters)}; "
            "correct it."
        )
    stated = dict(zip(names, map(float, parameters), strict=True))
    fx, fy = (stated[key if key in stated else "f"] for key in ("fx", "fy"))
    cx, cy = stated["cx"] - 0.5, stated["cy"] - 0.5
    distortion = coefficients(stated, lens, origin)
    distortion = distortion if "k3" in stated else distortion[:4]
    return Calibration(fx, fy, cx, cy, distortion, width, height, origin=origin, lens=lens)


def calibration_from_document(document: dict[str, Any], path: Path) -> Calibration:
    """Translate a camera in JSON or YAML, of :func:`camera_document` or as in ``intrinsics.json``.

    Raises the errors of UNUSABLE, and InputError for a lens that is not supported.
    """
    names = {str(key).removeprefix("Camera."): value for key, value in document.items()}  # ORB-SLAM
    lens = lens_of(names, path)
    fx, fy, cx, cy = _pinhole(names)
    stated = next((names[key] for key in _DISTORTIONS if names.get(key) is not None), None)
    stated = stated.get("data", ()) if isinstance(stated, dict) else stated
    size = next((names[key] for key in ("resolution", "image_size") if key in names), (None, None))
    edges = (
        next((names[key] for key in keys if names.get(key) is not None), known)
        for keys, known in zip(_SIZES, size, strict=True)
    )
    width, height = map(_optional_int, edges)
    distortion = coefficients(names, lens, path) if stated is None else _trimmed(stated, lens)
    found = Calibration(fx, fy, cx, cy, distortion, width, height, origin=str(path), lens=lens)
    account = unused_keys([names], KNOWN_KEYS, path)
    return replace(found, is_guess=bool(names.get("is_guess", False)), account=account)


def _pinhole(names: dict[str, Any]) -> tuple[float, ...]:
    """fx, fy, cx and cy, of pixel centres at integers."""
    if "intrinsics" in names:  # EuRoC and Kalibr
        fx, fy, cx, cy = names["intrinsics"]
        return float(fx), float(fy), float(cx), float(cy)
    if "fx" not in names:
        matrix = names["K"] if "K" in names else names["camera_matrix"]
        return pinhole_of(matrix["data"] if isinstance(matrix, dict) else matrix)
    centre = ("ppx", "ppy") if "ppx" in names else ("cx", "cy")  # RealSense
    return tuple(float(names[key]) for key in ("fx", "fy", *centre))


def _trimmed(stated: Sequence[Any], lens: LensModel) -> tuple[float, ...]:
    """Coefficients without zeros at the end that a lens has not."""
    rows = np.ravel(np.array(stated, dtype=np.float64)).tolist()
    most = (0, 4) if lens == "fisheye" else (0, 4, 5, 8)
    while len(rows) not in most and rows[-1] == 0:
        rows.pop()
    return tuple(rows)


def _from_numbers(text: str, path: Path) -> Calibration:
    rows = [line.split("#", 1)[0].replace(",", " ").split() for line in text.splitlines()]
    words = [word for row in rows for word in row]
    if words[:1] == [FISHEYE]:
        return calibration_from_words(words, str(path))
    numbers = [[float(word) for word in row] for row in rows if row]
    if len(numbers) >= 3 and all(len(row) == len(numbers) for row in numbers):
        matrix = [row[:3] for row in numbers[:3]]  # of 3x3 or 4x4
        return Calibration(*pinhole_of(matrix), origin=str(path))
    return calibration_from_numbers([number for row in numbers for number in row], str(path))


def _optional_int(number: Any) -> int | None:
    return None if number is None else whole_number(number)
