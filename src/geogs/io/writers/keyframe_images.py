"""``keyframes/``: the images of keyframes as they were used, and their masks."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from geogs.errors import InputError
from geogs.io.pictures import decoded
from geogs.io.writers.atomic import atomic_file

JPEG_QUALITY = 95


def image_path(folder: Path, keyframe_id: int) -> Path:
    """Where the image of a keyframe lies in the folder of a result."""
    return folder / "keyframes" / f"{keyframe_id:06d}.jpg"


def mask_path(folder: Path, keyframe_id: int) -> Path:
    """Where its mask lies, if it has one."""
    return folder / "keyframes" / f"{keyframe_id:06d}.mask.png"


def write_image(path: Path, image: UInt8[np.ndarray, "h w 3"]) -> None:
    """Write RGB as JPEG or PNG, by the suffix."""
    options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if path.suffix == ".jpg" else []
    _write(path, cv2.cvtColor(image, cv2.COLOR_RGB2BGR), options)


def write_mask(path: Path, mask: Bool[np.ndarray, "h w"]) -> None:
    """Write a mask as PNG: 255 where it is true."""
    _write(path, mask.astype(np.uint8) * 255, [])


def read_image(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """Read an image as RGB. Raises InputError if it is missing or damaged."""
    return cv2.cvtColor(_read(path, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB).astype(np.uint8)


def read_mask(path: Path) -> Bool[np.ndarray, "h w"]:
    """Read a mask. Raises InputError if it is missing or damaged."""
    return _read(path, cv2.IMREAD_GRAYSCALE) > 127


def _write(path: Path, picture: np.ndarray, options: list[int]) -> None:
    _, data = cv2.imencode(path.suffix, picture, options)
    with atomic_file(path) as stream:
        stream.write(data.tobytes())


def _read(path: Path, flags: int) -> np.ndarray:
    picture = decoded(path, flags).picture
    if picture is None:
        raise InputError(f"{path} is missing or damaged; the result needs it.")
    return picture
