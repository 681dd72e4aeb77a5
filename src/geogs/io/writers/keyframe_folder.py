"""``keyframes/``: the working images of keyframes, their masks, and the position and time of each
pixel in a rolling-shutter image."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, UInt8
from safetensors import SafetensorError
from safetensors.torch import load_file, save

from geogs.errors import InputError
from geogs.guard.atomic import atomic_file
from geogs.guard.documents import UNUSABLE
from geogs.io.pictures import decoded
from geogs.types import SeenRows

JPEG_QUALITY = 95


def image_path(folder: Path, keyframe_id: int) -> Path:
    """Path of a keyframe's image in the folder of a result."""
    return folder / "keyframes" / f"{keyframe_id:06d}.jpg"


def mask_path(folder: Path, keyframe_id: int) -> Path:
    """Path of its mask, if it has one."""
    return folder / "keyframes" / f"{keyframe_id:06d}.mask.png"


def write_image(path: Path, image: UInt8[np.ndarray, "h w 3"]) -> None:
    """Write RGB as JPEG or PNG, by the suffix."""
    options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if path.suffix == ".jpg" else []
    write_picture(path, cv2.cvtColor(image, cv2.COLOR_RGB2BGR), options)


def write_mask(path: Path, mask: Bool[np.ndarray, "h w"]) -> None:
    """Write a mask as PNG: 255 where it is true."""
    write_picture(path, mask.astype(np.uint8) * 255)


def read_image(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """Read an image as RGB. Raises InputError if it is missing or damaged."""
    return cv2.cvtColor(_read(path, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB).astype(np.uint8)


def read_mask(path: Path) -> Bool[np.ndarray, "h w"]:
    """Read a mask. Raises InputError if it is missing or damaged."""
    return _read(path, cv2.IMREAD_GRAYSCALE) > 127


def write_picture(path: Path, picture: np.ndarray, options: Sequence[int] = ()) -> None:
    """Write a picture, in OpenCV's order of channels, in the format of the suffix."""
    _, data = cv2.imencode(path.suffix, picture, options)
    with atomic_file(path) as stream:
        stream.write(data.tobytes())


def _read(path: Path, flags: int) -> np.ndarray:
    picture = decoded(path, flags).picture
    if picture is None:
        raise InputError(f"{path} is missing or damaged; the result needs it.")
    return picture


def rows_path(folder: Path) -> Path:
    """Path of the rows of keyframes in the folder of a result, if any were rectified."""
    return folder / "keyframes" / "rows.safetensors"


def write_rows(path: Path, rows: Mapping[int, SeenRows]) -> None:
    """Write the rows of keyframes, by id; all are of one size. Raises OutputError."""
    seen = list(rows.values())
    tensors = {
        "keyframe_id": torch.tensor(list(rows)),
        "offset": torch.stack([r.offset for r in seen]).cpu().half(),
        "seconds": torch.stack([r.seconds for r in seen]).cpu().half(),
        "doubt": torch.tensor([r.doubt for r in seen], dtype=torch.float64),
    }
    with atomic_file(path) as stream:
        stream.write(save(tensors))


def read_rows(path: Path) -> dict[int, SeenRows]:
    """Read the rows of keyframes; empty where there is no file.

    Raises:
        InputError: the file is damaged.
    """
    if not path.is_file():
        return {}
    try:
        tensors = load_file(path)
        ids = tensors["keyframe_id"].long()
        doubt = tensors["doubt"].double()
        offset = tensors["offset"].half()
        seconds = tensors["seconds"].half()
        if seconds.ndim != 3 or offset.shape != (*seconds.shape, 2):
            raise ValueError("it has no rows and columns")
        if not ids.shape == doubt.shape == seconds.shape[:1]:
            raise ValueError("its keyframes differ in number")
        if not all(bool(torch.isfinite(t).all()) for t in (offset, seconds, doubt)):
            raise ValueError("it holds NaN or infinity")
    except (SafetensorError, OSError, *UNUSABLE) as error:
        raise InputError(f"{path} is damaged; delete it to go without.") from error
    return {
        id: SeenRows(offset[n], seconds[n], float(doubt[n])) for n, id in enumerate(ids.tolist())
    }
