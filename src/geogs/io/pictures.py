"""Pictures from files, decoded without noise on the standard error or waiting for pipes.

The decoders are C libraries, which print messages. A JPEG that is damaged in its middle gives half
a picture and such a message, and no error.
"""

import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from geogs.errors import InputError
from geogs.guard.decoder_noise import decoder_noise
from geogs.guard.documents import open_file, read_bytes

LARGEST_PICTURE = 1 << 31
"""Largest file in bytes."""
_PIXELS_A_BYTE = 10_000
"""Pixels per byte of an all-black picture, compressed as well as any format can."""
_ORIENTATION, _QUARTER_TURNS = 0x0112, {3: 2, 4: 2, 5: 3, 6: 1, 7: 1, 8: 3}
"""Entry of the EXIF, and the clockwise quarter turns to the upright picture by its value."""
_TIFF = {b"II*\0": "little", b"MM\0*": "big"}
_TIFF_WIDTH, _TIFF_HEIGHT = 256, 257
_HARMLESS = 1 << 24
"""Number of pixels, or bytes, that is always quick to decode."""
_PNG = b"\x89PNG\r\n\x1a\n"
DEEP = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH
"""Flags of ``cv2.imdecode`` for colour of any number of bits, see ``tones.py``."""


@dataclass(frozen=True)
class Decoded:
    """A decoded picture."""

    picture: np.ndarray | None
    """In OpenCV's order of channels; none where there is no picture in the file."""
    is_damaged: bool = False
    """Whether the decoder complained, or the file is cut off, although there is a picture."""

    @property
    def rgb(self) -> UInt8[np.ndarray, "h w 3"] | None:
        """The picture in RGB, if it was decoded in colour."""
        return None if self.picture is None else cv2.cvtColor(self.picture, cv2.COLOR_BGR2RGB)


def decoded(path: Path, flags: int) -> Decoded:
    """Decode a picture with the flags of ``cv2.imdecode``; nothing is raised for a bad file."""
    try:
        data = np.frombuffer(read_bytes(path, LARGEST_PICTURE), np.uint8)
    except InputError:
        return Decoded(None)
    return decoded_bytes(data, flags)


def decoded_bytes(data: np.ndarray, flags: int) -> Decoded:
    """Decode the bytes of such a file."""
    if not len(data) or _claims_too_many_pixels(data) or _has_oversized_chunk(data):
        return Decoded(None)
    if flags & cv2.IMREAD_IGNORE_ORIENTATION:
        data = _without_turn(data)
    picture, noise = _decode(data, flags, alone=False)
    if noise:  # of this one, or of one that another thread decodes
        picture, noise = _decode(data, flags, alone=True)
    if picture is None and flags & DEEP == DEEP and data[:4].tobytes() in _TIFF:
        picture = _in_colour(_decode(data, cv2.IMREAD_UNCHANGED, alone=False)[0])
    is_damaged = any("corrupt" in line.lower() for line in noise) or _is_cut_off(data)
    return Decoded(picture, picture is not None and is_damaged)


def _decode(data: np.ndarray, flags: int, alone: bool) -> tuple[np.ndarray | None, list[str]]:
    """The picture, if there is one, and the decoders' messages."""
    with decoder_noise(alone) as noise:
        try:
            picture = cv2.imdecode(data, flags)
        except (cv2.error, MemoryError):
            picture = None
    return picture, noise


def _in_colour(picture: np.ndarray | None) -> np.ndarray | None:
    """A picture of any type of values with three channels."""
    if picture is None:
        return None
    return np.repeat(picture[..., None], 3, axis=2) if picture.ndim == 2 else picture[..., :3]


def header_of(path: Path) -> tuple[tuple[int, int], str] | None:
    """Width and height as stored, and Pillow's mode; none where there is no picture.

    Raises:
        InputError: it has too many pixels.
    """
    from PIL import Image

    try:
        with header_read(path) as picture:
            return size_and_turns(picture)[0], picture.mode
    except Image.DecompressionBombError:
        raise InputError(f"{path} has more than 178 megapixels; make it smaller.") from None
    except Exception:  # a damaged file may raise any exception
        return None


def upright_size(path: Path) -> tuple[int, int] | None:
    """Width and height of the :func:`decoded` picture; none where there is no picture."""
    size, turns = stored_size_and_turns(path)
    return size[::-1] if size and turns % 2 else size


def stored_size_and_turns(path: Path) -> tuple[tuple[int, int] | None, int]:
    """The :func:`size_and_turns` of a file; none and 0 where there is no picture."""
    try:
        with header_read(path) as picture:
            return size_and_turns(picture)
    except Exception:  # a damaged file may raise any exception
        return None, 0


def size_and_turns(picture: Any) -> tuple[tuple[int, int], int]:
    """Width and height of Pillow's picture as stored, and the clockwise quarter turns by which its
    EXIF makes it upright."""
    size: tuple[int, int] = picture.size
    if picture.format == "TIFF":  # of which Pillow tells the size upright
        size = picture.tag_v2[_TIFF_WIDTH], picture.tag_v2[_TIFF_HEIGHT]
    is_told = picture.format != "PNG" or "exif" in picture.info  # else Pillow decodes all of it
    return size, _QUARTER_TURNS.get(picture.getexif().get(_ORIENTATION), 0) if is_told else 0


@contextmanager
def header_read(path: Path) -> Iterator[Any]:
    """Open a picture with Pillow, which reads only the header, without warnings.

    A damaged file may raise any exception.
    """
    from PIL import Image

    with (
        decoder_noise(),
        open_file(path) as stream,
        warnings.catch_warnings(action="ignore"),
        Image.open(stream) as picture,
    ):
        yield picture


def _claims_too_many_pixels(data: np.ndarray) -> bool:
    """Whether a header claims more pixels than so few bytes can hold."""
    from PIL import Image

    warnings_ignored = warnings.catch_warnings(action="ignore")
    try:
        with warnings_ignored, Image.open(io.BytesIO(data.tobytes())) as picture:
            pixels = picture.width * picture.height
    except Image.DecompressionBombError:
        pixels = 2 * (Image.MAX_IMAGE_PIXELS or 0)
    except Exception:  # left to the decoder
        return False
    return pixels > most_pixels(len(data))


def most_pixels(size: int) -> int:
    """Most pixels that an image of a file of ``size`` bytes can have."""
    return max(_HARMLESS, _PIXELS_A_BYTE * size)


def _without_turn(data: np.ndarray) -> np.ndarray:
    """The bytes of a TIFF with the orientation 1, as OpenCV turns it whatever its flags; those of
    another picture unchanged."""
    order: Any = _TIFF.get(data[:4].tobytes())
    if order is None:
        return data
    at = int.from_bytes(data[4:8], order)
    end = at + 2 + 12 * int.from_bytes(data[at : at + 2], order)
    for entry in range(at + 2, min(end, len(data) - 11), 12):  # it may be cut off
        if int.from_bytes(data[entry : entry + 2], order) == _ORIENTATION:
            data = data.copy()
            data[entry + 8 : entry + 10] = np.frombuffer((1).to_bytes(2, order), np.uint8)
    return data


def _has_oversized_chunk(data: np.ndarray) -> bool:
    """Whether a chunk of a PNG claims to be far longer than the file, for which OpenCV would
    allocate up to 4 GiB."""
    file = data.data
    at = len(_PNG)
    if file[:at] != _PNG:
        return False
    while at + 4 <= len(file):
        length = int.from_bytes(file[at : at + 4], "big")
        if length > max(_HARMLESS, len(file) - at):
            return True
        at += 12 + length  # with its length, its name and its checksum
    return False


def _is_cut_off(data: np.ndarray) -> bool:
    """Whether a JPEG has no end, as some decoders forgive."""
    return data[:2].tobytes() == b"\xff\xd8" and b"\xff\xd9" not in data[2:].tobytes()


def read_mask(
    path: Path, shape: tuple[int, int], of_alpha: bool = False
) -> Bool[np.ndarray, "h w"]:
    """Read which pixels of a picture to use: those that are bright, or opaque.

    Args:
        path: the mask, or the picture with an alpha channel.
        shape: height and width of the picture; a mask of another size is scaled to it.
        of_alpha: whether the alpha channel counts; without one all pixels are used.

    Raises:
        InputError: there is no mask, or it is not as wide for its height as the picture.
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
        _check_shape(path, used.shape, shape)
        used = cv2.resize(used.astype(np.uint8), shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
    return used


def _check_shape(path: Path, mask: tuple[int, ...], picture: tuple[int, int]) -> None:
    """Raises InputError where one is not the other scaled, up to rounding to whole pixels."""
    (h, w), (height, width) = mask, picture
    if abs(w * height - h * width) > 0.5 * (height + width) + 0.005 * w * height:
        raise InputError(
            f"The mask {path} has {w}x{h} pixels, and the image {width}x{height}; give one of the "
            "same shape, upright."
        )
