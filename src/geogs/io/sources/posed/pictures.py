"""Read the pictures and masks of an image set as they are stored."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

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


def has_alpha(path: Path) -> bool:
    """Whether a picture has an alpha channel, from the header alone."""
    header = header_of(path)
    return header is not None and header[1] in ("RGBA", "LA", "PA")
