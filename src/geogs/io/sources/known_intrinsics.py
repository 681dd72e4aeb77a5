"""Choice of a source's intrinsics: the user's, the data set's, the photograph's, or a guess."""

import logging
import math
from collections.abc import Mapping
from pathlib import Path

from geogs.errors import InputError
from geogs.guard.documents import first_file
from geogs.io.pictures import header_read, size_and_turns
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.calibration_files import (
    NoFocalLengthError,
    calibration_from_words,
    read_calibration,
)

GUESSED_FIELD_OF_VIEW = 60.0
"""Degrees along the longer image side, assumed where nothing is known: a phone's main camera."""

_FILES = (
    "intrinsics.json",
    "cam_params.json",
    "transforms.json",
    "cameras.txt",
    "sparse/0/cameras.txt",
    "intrinsic/intrinsic_color.txt",
    "sensor.yaml",
    "calib.txt",
    "calibration.txt",
)
_FULL_FRAME_DIAGONAL = math.hypot(36.0, 24.0)
_EXIF_IFD, _FOCAL_LENGTH_35MM = 0x8769, 0xA405

_log = logging.getLogger(__name__)


def resolve_intrinsics(
    option: str,
    known: Calibration | None,
    width: int,
    height: int,
    quarter_turns: int = 0,
    pixel_aspect: float = 1.0,
) -> Calibration:
    """Turn ``InputConfig.intrinsics`` into the calibration of ``width x height`` images.

    Args:
        option: ``auto``, the path of a calibration file, or comma-separated numbers.
        known: calibration of the data set or the photographs; used for ``auto``.
        width: width of the images as shown, in pixels.
        height: their height.
        quarter_turns: clockwise turns from the stored to the shown images, see Calibration.fit.
        pixel_aspect: width by height of a pixel of the images as shown, for the guess.
    """
    if option.strip().lower() == "auto":
        calibration = known or guess_calibration(width, height, pixel_aspect)
        if calibration.is_guess:
            # No warning yet: a run estimates the focal length from the video.
            _log.info("The intrinsics are unknown; assuming %s.", calibration.origin)
        return calibration.fit(width, height, quarter_turns)
    return _from_option(option).fit(width, height, quarter_turns)


def guess_calibration(width: int, height: int, pixel_aspect: float = 1.0) -> Calibration:
    """A pinhole with its centre in the middle and an ordinary field of view."""
    longer = max(width * pixel_aspect, height)
    focal = longer / 2 / math.tan(math.radians(GUESSED_FIELD_OF_VIEW / 2))
    return Calibration(
        focal / pixel_aspect,
        focal,
        (width - 1) / 2,
        (height - 1) / 2,
        width=width,
        height=height,
        is_guess=True,
        origin=f"a field of view of {GUESSED_FIELD_OF_VIEW:g} degrees",
    )


def find_calibration(*folders: Path) -> Calibration | None:
    """Read the first calibration file of a known name in ``folders``, if there is one."""
    file = first_file(folder / name for folder in folders for name in _FILES)
    try:
        return None if file is None else read_calibration(file)
    except NoFocalLengthError:
        return None


def calibration_from_exif(image: Path) -> Calibration | None:
    """Derive the focal length of a photograph from its 35 mm equivalent, if the EXIF holds one.

    The equivalent compares diagonals (CIPA DCG-001): f / 43.27 mm is focal length by diagonal.
    """
    try:
        with header_read(image) as photograph:
            exif: Mapping[int, object] = photograph.getexif().get_ifd(_EXIF_IFD)
            (width, height), _ = size_and_turns(photograph)
    except Exception:  # damaged EXIF may raise any exception
        return None
    equivalent = exif.get(_FOCAL_LENGTH_35MM)
    if not isinstance(equivalent, int | float) or not 3 <= equivalent <= 3000:  # or a wrong entry
        return None
    focal = equivalent / _FULL_FRAME_DIAGONAL * math.hypot(width, height)
    return Calibration(
        focal,
        focal,
        (width - 1) / 2,
        (height - 1) / 2,
        origin=f"EXIF of {image.name} ({equivalent:g} mm equivalent)",
        is_nominal=True,
    )


def _from_option(option: str) -> Calibration:
    if Path(option).is_file():
        return read_calibration(Path(option))
    words = option.replace(",", " ").split()
    try:
        return calibration_from_words(words, "as given")
    except ValueError:
        raise InputError(
            f"intrinsics {option} is neither auto, nor a file that exists, nor numbers "
            f"fx,fy,cx,cy[,k1,k2,p1,p2[,k3]] or fisheye,fx,fy,cx,cy[,k1,k2,k3,k4]."
        ) from None
