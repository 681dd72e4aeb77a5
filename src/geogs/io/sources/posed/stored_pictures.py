"""Read the stored pictures and masks of an image set."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from geogs.errors import InputError
from geogs.guard.documents import open_file
from geogs.io.pictures import DEEP, decoded, header_of, stored_size_and_turns
from geogs.io.sources.pose_priors import turned_upright
from geogs.io.sources.posed.posed_set import PosedFile
from geogs.io.sources.tones import UPPER_BITS, Tones

_REDUCED = {
    1: DEEP,
    2: cv2.IMREAD_REDUCED_COLOR_2,
    4: cv2.IMREAD_REDUCED_COLOR_4,
    8: cv2.IMREAD_REDUCED_COLOR_8,
}
"""OpenCV's flags to decode a picture at a fraction of its size."""


def stored_size(path: Path) -> tuple[int, int] | None:
    """Width and height as stored, from the header alone; none where there is no picture."""
    header = header_of(path)
    return None if header is None else header[0]


def of_stored_pixels(file: PosedFile) -> PosedFile:
    """The image with the pose and camera of its stored pixels, where these are of the picture as
    EXIF turns it, which the size of the camera tells."""
    size, turns = stored_size_and_turns(file.path)
    camera = file.calibration
    if turns % 2 == 0 or size is None or camera is None or camera.width is None:
        return file
    is_upright = (camera.width - (camera.height or 0)) * (size[0] - size[1]) < 0
    if not is_upright:
        return file
    turned = turned_upright(np.eye(4), -turns)
    T_cw = turned.T @ file.T_cw
    return replace(file, T_cw=T_cw, calibration=camera.fit(*size, quarter_turns=-turns))


def read_picture(
    path: Path,
    size: tuple[int, int] | None = None,
    needed: tuple[int, int] | None = None,
    tones: Tones = UPPER_BITS,
) -> UInt8[np.ndarray, "h w 3"]:
    """Read a picture as RGB, not turned by its EXIF orientation: poses are for stored pixels.

    Args:
        path: the file.
        size: width and height it must have.
        needed: width and height that suffice: a JPEG of a known size is decoded at a half, a
            quarter or an eighth of it, which averages whole blocks of pixels, where that is no
            smaller. That saves time and memory.
        tones: of a picture with more than 8 bits.

    Raises:
        InputError: it is missing or damaged, or of another size.
    """
    parts = 1
    if size is not None and needed is not None and _is_jpeg(path):
        parts = reduction(size, needed)
    picture = decoded(path, _REDUCED[parts] | cv2.IMREAD_IGNORE_ORIENTATION).picture
    edges = None if picture is None else (parts * picture.shape[1], parts * picture.shape[0])
    if picture is None or (size is not None and edges != size):
        raise InputError(f"{path} is damaged; copy it again, or leave it out.")
    return cv2.cvtColor(tones(picture), cv2.COLOR_BGR2RGB)


def reduction(size: tuple[int, int], needed: tuple[int, int]) -> int:
    """The largest of 8, 4, 2 and 1 that divides both sides without a rest, such that no side
    becomes smaller than needed."""
    fits = (
        n
        for n in (8, 4, 2)
        if all(s % n == 0 and s // n >= least for s, least in zip(size, needed, strict=True))
    )
    return next(fits, 1)


def _is_jpeg(path: Path) -> bool:
    try:
        with open_file(path) as file:
            return file.read(3) == b"\xff\xd8\xff"
    except InputError:
        return False


def has_alpha(path: Path) -> bool:
    """Whether a picture has an alpha channel, from the header alone."""
    header = header_of(path)
    return header is not None and header[1] in ("RGBA", "LA", "PA")
