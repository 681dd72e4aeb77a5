"""Pictures that are no pinhole image: stereo pairs in one picture, and 360-degree panoramas.

They are recognised by their content. ``--take`` chooses the part to use, a half or a perspective
view; it is cut out before anything else reads the images.
"""

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from geogs.errors import InputError
from geogs.io.sources.account import Account
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.known_intrinsics import guess_calibration
from geogs.io.sources.reader import RawFrame, Reader, SpreadReader, of_one_size

_DIRECTION = re.compile(r"360:(-?\d+(?:\.\d+)?),(-?\d+(?:\.\d+)?)")
_SAME_SHAPE = 0.03
"""Largest relative difference of two shapes that count as one."""
_LEAST_IMAGES = 4
"""Least number of images that tell."""
_ROWS, _COLUMNS = 96, 128
"""Size to which halves are reduced before they are compared."""
_BLOCKS = 4
"""Blocks of a half in each direction, each with its own shift."""
_SHIFT = 10
"""Largest shift between two views, in reduced pixels along the row."""
_LEAST_LIKE, _LEAST_MORE = 0.4, 0.2
"""Least correlation of the halves of an image, and by how much it exceeds that with a half of
another image; plain video reached 0.22 and 0.03."""
_SEAM = 0.35
"""Largest difference of the left and right edge of a panorama, relative to unrelated columns."""
_POLE = 0.4
"""Largest variation along the rows at a pole, relative to the rows in the middle."""
_LEAST_CONTRAST = 6.0
"""Least standard deviation of the middle rows and of the edge columns, in grey levels."""


@dataclass(frozen=True)
class Half:
    """A half of each image."""

    axis: int
    """Axis of the array that is cut: 1 for left or right, 0 for top or bottom."""
    second: bool
    """Whether it is the right or the bottom one."""

    def __call__(self, image: UInt8[np.ndarray, "h w *c"]) -> UInt8[np.ndarray, "h2 w2 *c"]:
        """Cut it out."""
        side = image.shape[self.axis]
        half = slice((side + 1) // 2, None) if self.second else slice(side // 2)
        return np.ascontiguousarray(image[:, half] if self.axis == 1 else image[half])

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height of the half of an image."""
        return (width // 2, height) if self.axis == 1 else (width, height // 2)

    def camera(self, width: int, height: int) -> Calibration | None:
        """The camera of a half that was squeezed to half of its width or height; none if it does
        not look so."""
        across, down = (2, 1) if self.axis == 1 else (1, 2)
        if not _is_shape(across * width, down * height, 16 / 9):
            return None
        full = guess_calibration(across * width, down * height)
        return replace(
            full,
            fx=full.fx / across,
            fy=full.fy / down,
            cx=(width - 1) / 2,
            cy=(height - 1) / 2,
            width=width,
            height=height,
            origin=f"{full.origin}, squeezed to half of a 16:9 picture",
        )


@dataclass(frozen=True)
class Direction:
    """A perspective view of 90 x 90 degrees from an equirectangular panorama."""

    yaw: float
    """Degrees to the right of the middle column."""
    pitch: float
    """Degrees upwards."""

    def __call__(self, image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "n n 3"]:
        """Render the view."""
        height, width = image.shape[:2]
        return cv2.remap(
            image, *self._maps(width, height), cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
        )

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height of the view. Raises InputError if the image is no whole panorama."""
        if not _is_shape(width, height, 2.0):
            raise InputError(
                f"The images are {width}x{height} pixels, but a whole panorama of 360 degrees is "
                "twice as wide as high; take a half of a stereo picture by left, right, top or "
                "bottom, such as --take top+front."
            )
        return width // 2, width // 2

    def camera(self, width: int, height: int) -> Calibration:
        """The exact camera of the view."""
        focal = width / 2
        centre = (width - 1) / 2
        origin = f"a view of 90 degrees cut out at yaw {self.yaw:g}, pitch {self.pitch:g}"
        return Calibration(focal, focal, centre, centre, (), width, height, origin)

    def _maps(
        self, width: int, height: int
    ) -> tuple[Float32[np.ndarray, "n n"], Float32[np.ndarray, "n n"]]:
        """Column and row of the panorama for each pixel of the view."""
        side = self.size(width, height)[0]
        offsets = (np.arange(side) - (side - 1) / 2) / (side / 2)
        x, y = np.meshgrid(offsets, offsets)
        pitch = math.radians(self.pitch)
        down = y * math.cos(pitch) - math.sin(pitch)
        ahead = y * math.sin(pitch) + math.cos(pitch)
        longitude = np.arctan2(x, ahead) + math.radians(self.yaw)
        latitude = np.arctan2(down, np.hypot(x, ahead))
        column = (longitude / math.tau + 0.5) % 1 * width - 0.5
        row = ((latitude / math.pi + 0.5) * height - 0.5).clip(0, height - 1)
        return column.astype(np.float32), row.astype(np.float32)


View = Half | Direction
_NAMED: dict[str, View] = {
    "left": Half(1, False),
    "right": Half(1, True),
    "top": Half(0, False),
    "bottom": Half(0, True),
    "front": Direction(0.0, 0.0),
    "back": Direction(180.0, 0.0),
}


class TakenReader:
    """Reader of a part of each image of another reader."""

    def __init__(self, reader: Reader, views: Sequence[View], option: str) -> None:
        """``views`` are taken one after the other; ``option`` is their name for the account."""
        self._reader = reader
        self._views = views
        info = reader.info
        width, height = info.width, info.height
        known = None
        for view in views:
            width, height = view.size(width, height)
            known = view.camera(width, height)
        lost = (f"sensor depth: it is not cut to {option}",) if info.has_depth else ()
        account = Account((f"{option} of images of {info.width}x{info.height} pixels",), lost)
        self.info = replace(
            info,
            width=width,
            height=height,
            calibration=known,
            depths=0,
            account=info.account + account,
        )

    @property
    def paths(self) -> Sequence[Path]:
        """The files that are read."""
        return self._reader.paths

    def read(self, start: int, stop: int | None, stride: int) -> Iterator[RawFrame]:
        """Read parts of the images."""
        return map(self._taken, self._reader.read(start, stop, stride))

    def spread(self, starts: Sequence[int]) -> Iterator[RawFrame]:
        """Read parts of the images near these; none where the reader cannot."""
        if not isinstance(self._reader, SpreadReader):
            return iter(())
        return map(self._taken, self._reader.spread(starts))

    def _taken(self, raw: RawFrame) -> RawFrame:
        raw = of_one_size(raw, self._reader.info)
        image = raw.image
        if image is None:
            return raw
        for view in self._views:
            image = view(image)
        return replace(raw, image=image, depth=None)


def taken(reader: Reader, option: str) -> Reader:
    """The reader of the part of the images that ``--take`` names; itself for auto and none.

    Raises:
        InputError: it names no part, or the images have no such part.
    """
    views = views_of(option)
    return TakenReader(reader, views, option) if views else reader


def views_of(option: str) -> list[View]:
    """The views of a value of ``--take``, which ``+`` joins. Raises InputError if it names none."""
    if option in ("auto", "none"):
        return []
    return [_view(word) for word in option.lower().split("+")]


def _view(word: str) -> View:
    if word in _NAMED:
        return _NAMED[word]
    found = _DIRECTION.fullmatch(word)
    if found is None:
        raise InputError(
            f"take {word} names no part of an image; give left, right, top or bottom of a stereo "
            "picture, or front, back or 360:YAW,PITCH of a panorama."
        )
    yaw, pitch = map(float, found.groups())
    if not -90 <= pitch <= 90:
        raise InputError(f"take {word} has a pitch of {pitch:g} degrees; give -90 to 90.")
    return Direction(yaw, pitch)


def no_pinhole(images: Sequence[UInt8[np.ndarray, "h w 3"]]) -> str | None:
    """Sentence on images that are no pinhole images, with the help; none if they are.

    Args:
        images: upright and of one size, spread over a recording.
    """
    if len(images) < _LEAST_IMAGES:
        return None
    grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in images]
    if _is_panorama(grey):
        return (
            "is a panorama of 360 degrees (its left and right edge join); --take front uses a "
            "view of 90 degrees, --take 360:YAW,PITCH that in another direction"
        )
    for name, one, other in (
        ("side by side", "left", "right"),
        ("one above the other", "top", "bottom"),
    ):
        if _is_stereo(grey, _NAMED[one], _NAMED[other]):
            return (
                f"shows two views {name} in each image, as a stereo camera records them; "
                f"--take {one} or --take {other} uses one of them"
            )
    return None


def _is_shape(width: int, height: int, ratio: float) -> bool:
    return abs(width / height / ratio - 1) <= _SAME_SHAPE


def _is_panorama(images: Sequence[UInt8[np.ndarray, "h w"]]) -> bool:
    """Whether the images are whole equirectangular panoramas."""
    height, width = images[0].shape
    if not _is_shape(width, height, 2.0):
        return False
    rows = slice(height // 6, height - height // 6)
    pole = max(height // 100, 1)
    votes = []
    for image in np.stack(images).astype(np.float32):
        first, second, last = image[rows, 0], image[rows, 1], image[rows, -1]
        unlike = np.abs(image[rows, : width // 2] - image[rows, width // 2 :][:, : width // 2])
        step = np.abs(first - last).mean()
        joins = step < max(_SEAM * unlike.mean(), 1.5 * np.abs(first - second).mean())
        along = image.std(axis=1)
        at_pole = min(along[:pole].mean(), along[-pole:].mean())
        votes.append(
            joins
            and at_pole < _POLE * np.median(along[rows])
            and min(np.median(along[rows]), first.std()) > _LEAST_CONTRAST
        )
    return bool(np.mean(votes) > 0.75)


def _is_stereo(images: Sequence[UInt8[np.ndarray, "h w"]], first: View, second: View) -> bool:
    """Whether two halves show the same but for a shift along the rows."""
    one, other = ([_detail(half(image)) for image in images] for half in (first, second))
    far = len(images) // 2
    own = [_likeness(a, b) for a, b in zip(one, other, strict=True)]
    mixed = [_likeness(a, b) for a, b in zip(one, other[far:] + other[:far], strict=True)]
    like = float(np.median(own))
    return like > _LEAST_LIKE and like - float(np.median(mixed)) > _LEAST_MORE


def _detail(half: UInt8[np.ndarray, "h w"]) -> Float32[np.ndarray, "rows columns"]:
    """A reduced half without its slow changes of brightness."""
    small = cv2.resize(half, (_COLUMNS, _ROWS), interpolation=cv2.INTER_AREA)
    small = small.astype(np.float32)
    return small - cv2.GaussianBlur(small, (0, 0), 4)


def _likeness(one: Float32[np.ndarray, "h w"], other: Float32[np.ndarray, "h w"]) -> float:
    """Median over blocks of their largest correlation along the row."""
    rows, columns = _ROWS // _BLOCKS, (_COLUMNS - 2 * _SHIFT) // _BLOCKS
    found = []
    for top in range(0, _ROWS, rows):
        for left in range(_SHIFT, _COLUMNS - _SHIFT - columns + 1, columns):
            block = one[top : top + rows, left : left + columns]
            strip = other[top : top + rows, left - _SHIFT : left + columns + _SHIFT]
            if block.std() > 1:
                found.append(float(cv2.matchTemplate(strip, block, cv2.TM_CCOEFF_NORMED).max()))
    return float(np.median(found)) if len(found) >= _BLOCKS else 0.0
