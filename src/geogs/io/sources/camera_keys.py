"""Keys of a camera in JSON and YAML: its lens, its focal length, and keys that are not used.

nerfstudio, instant-ngp and Blender (``transforms.json``), Kalibr, OpenCV and ROS name the same
things differently. Keys that change the projection and are not supported are refused.
"""

import math
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from geogs.camera.distortion import LensModel
from geogs.errors import InputError
from geogs.io.sources.account import Account

Entry = Mapping[str, Any]

_LENS_NAMES: dict[LensModel, str] = {
    "polynomial": "opencv fullopencv pinhole simplepinhole perspective simpleradial radial brown "
    "brownconrady polynomial standard radtan radialtangential pinholeradtan plumbbob rational "
    "rationalpolynomial none",
    "fisheye": "fisheye equidistant equi pinholeequi opencvfisheye kannalabrandt kannalabrandt4 "
    "kannalabrandt8 kb4 kb8 simpleradialfisheye radialfisheye simplefisheye",
}
"""Names of lenses in files, their lower-case letters and digits alone."""
_LENSES = {name: lens for lens, names in _LENS_NAMES.items() for name in names.split()}
_MODELS = ("distortion_model", "camera_model", "lens", "lens_model")
"""Keys with the name of a lens; the first is of the distortion of a pinhole camera."""
_PERHAPS_MODELS = ("camera_type", "model", "type", "projection")
"""Keys with the name of a lens, or with anything else."""
_FLAGS = ("is_fisheye", "fisheye", "fisheye_model")
_TRUE = ("true", "1", "1.0")
_OTHER_LENSES = re.compile(
    r"[\w.-]*(fisheye624|ftheta|fov|latlong|equirect|panoram|spher|omni(?!vision)|orthogra|orthophoto"
    r"|vr180|eucm|double|mei\b|prism|division)[\w.-]*"
)
"""Names of lenses that are not supported, where a name may be that of something else."""
_OTHER_KEYS = re.compile(
    r"ftheta_\w+|latlong|equirectangular|is_equirectangular|panorama|spherical|orthographic"
    r"|is_orthographic|ortho_scale|skew|xi|s[1-4]|sx1|sy1|b[12]"
)
"""Keys that, unless zero or false, state a projection that is not supported."""
MOST_SKEW = 0.5
"""Largest skew in pixels that is neglected."""
_LEAST_PIXELS = dict.fromkeys(("skew", "b1", "b2"), MOST_SKEW)
_OTHER_AXES = ("normal_mts_args", "from_na")
"""Keys of instant-ngp's relatives for poses in other axes."""
_UNITS = {"fl_{}": None, "{}_fov": math.pi / 180, "camera_angle_{}": 1.0}
"""Keys of the focal length in pixels, or of the field of view with its unit in radians."""
_FOCAL_KEYS = tuple(key.format(axis) for key in _UNITS for axis in "xy")
_NARROWEST, _WIDEST = math.radians(3.2), math.radians(179)
"""Limits of a field of view: less is an angle in the wrong unit."""
_SAME = 0.02
"""Relative difference up to which two statements of a focal length agree."""
_COEFFICIENTS: dict[LensModel, str] = {"polynomial": "k1 k2 p1 p2 k3", "fisheye": "k1 k2 k3 k4"}
_RATIONAL = "k1 k2 p1 p2 k3 k4 k5 k6"
_CAMERA_KEYS = {*_RATIONAL.split(), *_FOCAL_KEYS, *_MODELS, *_FLAGS, "cx", "cy", "w", "h"}
_NAME = re.compile(r"[\w.-]{1,40}")
"""Words of a file that a message may repeat."""
_MOST_KEYS = 8
"""Largest number of keys that one sentence names."""
READOUT = "rolling_shutter"
"""Key of instant-ngp for the times of the rows."""


def lens_of(entry: Entry, path: Path | str) -> LensModel:
    """The lens of a camera: a polynomial one where nothing is stated.

    Raises:
        InputError: it is another one, or two keys contradict each other.
    """
    for key, value in entry.items():
        is_small = isinstance(value, int | float) and abs(value) <= _LEAST_PIXELS.get(key, 0)
        if value and not is_small and (_OTHER_KEYS.fullmatch(key) or key in _OTHER_AXES):
            what = "poses in other axes" if key in _OTHER_AXES else "a projection"
            raise InputError(
                f"{path} says {key}: {what} not supported here; convert it, or undistort the "
                "images to a pinhole camera first."
            )
    stated = {key: lens_named(str(entry[key]), path) for key in _MODELS if entry.get(key)}
    if "distortion_model" in stated:
        stated.pop("camera_model", None)  # Kalibr's pinhole, whose distortion is the other
    stated |= {k: lens for k in _PERHAPS_MODELS if (lens := _perhaps_lens(entry.get(k), path))}
    flags = {key: str(entry[key]).lower() for key in _FLAGS if entry.get(key) is not None}
    stated |= {k: "fisheye" if flag in _TRUE else "polynomial" for k, flag in flags.items()}
    if len(set(stated.values())) > 1:
        raise InputError(
            f"{path}: {' and '.join(stated)} contradict each other, one of a fisheye and one of "
            "none; remove the wrong one."
        )
    return next(iter(stated.values()), "polynomial")


def lens_named(model: str, path: Path | str) -> LensModel:
    """The lens of that name in a file. Raises InputError for one that is not supported."""
    lens = _LENSES.get(_plain(model))
    if lens is None:
        name = f"{model} camera" if _NAME.fullmatch(model) else "camera of that model"
        raise InputError(
            f"{path} describes a {name}, which is not supported; undistort the images first."
        )
    return lens


def _perhaps_lens(name: Any, path: Path | str) -> LensModel | None:
    """The lens, or none where the name is that of something else, such as a phone."""
    if not isinstance(name, str):
        return None
    is_lens = _plain(name) in _LENSES or _OTHER_LENSES.fullmatch(name.lower())
    return lens_named(name.lower(), path) if is_lens else None


def _plain(name: str) -> str:
    """The letters and digits of a name of a lens."""
    return re.sub(r"[^a-z0-9]", "", name.lower().removeprefix("distortion."))


def coefficients(entry: Entry, lens: LensModel, path: Path | str) -> tuple[float, ...]:
    """The distortion that ``k1``, ``p1``, ... state, in OpenCV's order; empty where all are zero.

    Raises:
        InputError: one belongs to another lens.
        ValueError, TypeError: one is no number.
    """
    stated = {key: float(entry[key]) for key in _RATIONAL.split() if entry.get(key)}
    is_rational = lens == "polynomial" and ("k5" in entry or "k6" in entry)
    order = (_RATIONAL if is_rational else _COEFFICIENTS[lens]).split()
    if others := [key for key in stated if key not in order]:
        raise InputError(
            f"{path} has {', '.join(others)}, which a {lens} lens has not; name the right "
            "camera_model (OPENCV_FISHEYE for a fisheye), or undistort the images first."
        )
    return tuple(stated.get(key, 0.0) for key in order) if stated else ()


def of_frame(document: Entry, frame: Entry) -> dict[str, Any]:
    """Keys of one image over those of all; a lens or a focal length that it states by whatever
    key replaces that of all."""
    groups = ((*_MODELS, *_FLAGS), _FOCAL_KEYS)
    stated = (keys for keys in groups if any(frame.get(key) is not None for key in keys))
    replaced = {key for keys in stated for key in keys}
    pairs = [pair for pair in document.items() if pair[0] not in replaced]
    return {key: value for key, value in (*pairs, *frame.items()) if value is not None}


def has_focal_length(entry: Entry) -> bool:
    """Whether a camera of ``transforms.json`` states its focal length in any way."""
    return any(entry.get(key) is not None for key in _FOCAL_KEYS)


def focal_lengths(entry: Entry, path: Path | str) -> tuple[float, float, str, Account]:
    """fx and fy in pixels, the key that states fx, and what contradicts it.

    A single one is of both; ``w`` and ``h`` are asked for fields of view.

    Raises:
        InputError: a field of view is in the wrong unit.
        KeyError: there is no focal length, or no image size for a field of view.
        ValueError, TypeError: a value is no number.
    """
    found: dict[str, tuple[float, str]] = {}
    left = []
    for axis, edge in zip("xy", "wh", strict=True):
        for pattern, unit in _UNITS.items():
            key = pattern.format(axis)
            if entry.get(key) is None:
                continue
            value = float(entry[key])
            focal = (
                value if unit is None else _from_angle(value, unit, float(entry[edge]), key, path)
            )
            known, _ = found.setdefault(axis, (focal, key))
            if abs(focal / known - 1) > _SAME:
                left.append(f"{key} of {path}: it says {focal:.1f} pixels, not {known:.1f}")
    fx, key = found.get("x") or found.get("y") or (entry["fl_x"], "")
    return fx, found.get("y", (fx, key))[0], key, Account(left=tuple(left))


def _from_angle(value: float, unit: float, edge: float, key: str, path: Path | str) -> float:
    """Focal length in pixels of a field of view across an edge of the image."""
    if not _NARROWEST < value * unit < _WIDEST:
        name = "radians" if unit == 1 else "degrees"
        raise InputError(
            f"{path}: {key} is {value:g} {name}, which no lens has; is it in another unit? x_fov "
            "and y_fov are in degrees, camera_angle_x and camera_angle_y in radians."
        )
    return edge / 2 / math.tan(value * unit / 2)


def unused_keys(entries: Iterable[Entry], known: str, path: Path) -> Account:
    """An account of the keys in parts of a file that are neither those of a camera nor otherwise
    ``known`` (separated by spaces), and not zero or empty."""
    names = dict.fromkeys(
        str(key)
        for entry in entries
        for key, value in entry.items()
        if value and not (key in _PERHAPS_MODELS and _perhaps_lens(value, path))
    )
    unknown = (key for key in names if key not in _CAMERA_KEYS.union(known.split()))
    others = sorted(filter(_NAME.fullmatch, unknown), key=lambda key: key != READOUT)
    if not others:
        return Account()
    more = f" and {len(others) - _MOST_KEYS} more" if len(others) > _MOST_KEYS else ""
    hint = " (--readout gives its time)" if READOUT in others else ""
    return Account(left=(f"keys {', '.join(others[:_MOST_KEYS])}{more} of {path}{hint}",))
