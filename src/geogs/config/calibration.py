"""Settings of self-calibration."""

from dataclasses import dataclass
from typing import Annotated

from geogs.config.setting import Basic, Settings


@dataclass(frozen=True)
class CalibrationConfig(Settings, group="calibration"):
    """How intrinsics that nobody gave are found from the video itself.

    Intrinsics that the user or a data set gives are never changed.
    """

    refine: Annotated[bool, Basic()] = True
    """Whether a guessed focal length, or one from EXIF, is refined before the run."""
    radial: Annotated[bool, Basic()] = False
    """Also find one radial distortion term (OpenCV's k1) and undistort the images by it."""
