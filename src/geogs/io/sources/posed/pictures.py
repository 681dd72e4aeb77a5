"""Read the pictures and masks of an image set as they are stored."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from geogs.errors import InputError
from geogs.io.pictures import decoded, header_of


def stored_size(path: Path) -> tuple[int, int] | None:
    """Width and height as stored, from the header alone; none where there is no picture."""
    header = header_of(path)
    return None if header is None else header[0]


def read_picture(path: Path, size: tuple[int, int] | None = None) -> UInt8[np.ndarray, "h w 3"]:
    """Read a picture as RGB, not turned by its EXIF orientation: poses are for stored pixels.

    Args:
        path: the file.
        size: width and height it must have.

    Raises:
        InputError: it is missing or damaged, or of another size.
    """
    picture = decoded(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION).picture
    if picture is None or (size is not None and picture.shape[1::-1] != size):
        raise InputError(f"{path} is damaged; copy it again, or leave it out.")
    return cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)


def read_mask(
    path: Path, shape: tuple[int, int], of_alpha: bool = False
) -> Bool[np.ndarray, "h w"]:
    """Read which pixels of a picture to use: those that are bright, or opaque.

    Args:
        path: the mask, or the picture with an alpha channel.
        shape: height and width of the picture; a mask of another size is scaled to it.
        of_alpha: whether the alpha channel counts; without one all pixels are used.
    """
    mask = decoded(path, cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION).picture
    if mask is None:
        raise InputError(f"The mask {path} is missing or damaged; copy it again.")
    half = np.iinfo(mask.dtype).max // 2 if mask.dtype.kind in "iu" else 0
    if of_alpha and (mask.ndim == 2 or mask.shape[2] != 4):
        return np.ones(shape, dtype=bool)
    if mask.ndim == 3:
        mask = mask[..., 3] if of_alpha else mask[..., :3].max(axis=2)
    # Masks of zeros and ones are common, too.
    used = mask > (half if mask.max() > 1 else 0)
    if used.shape != shape:
        used = cv2.resize(used.astype(np.uint8), shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
    return used


def has_alpha(path: Path) -> bool:
    """Whether a picture has an alpha channel, from the header alone."""
    header = header_of(path)
    return header is not None and header[1] in ("RGBA", "LA", "PA")
