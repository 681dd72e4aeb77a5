"""Settings of self-calibration."""

from dataclasses import dataclass
from typing import Annotated

from geogs.config.setting import Basic, Count, Range, Settings, Share


@dataclass(frozen=True)
class CalibrationConfig(Settings, group="calibration"):
    """How intrinsics that nobody gave are found from the video itself.

    Intrinsics that the user or a data set gives are never changed.
    """

    refine: Annotated[bool, Basic()] = True
    """Whether a guessed focal length, or one from EXIF, is refined before the run."""
    radial: Annotated[bool, Basic()] = False
    """Also find one radial distortion term (OpenCV's k1) and undistort the images by it."""
    frames: Count = 600
    """Frames of the video that are looked at, at most."""
    start_keyframes: Annotated[int, Range(8, 1000)] = 12
    """Keyframes of a stretch that are solved first."""
    keyframes: Annotated[int, Range("start_keyframes", 1000)] = 36
    """Most keyframes of a stretch; they are added until the focal length is sure enough."""
    keyframe_flow: Share = 0.025
    """Median motion that makes a frame a keyframe, of the long edge."""
    enough: Share = 0.0021
    """Relative deviation of the focal length from which no more keyframes of a stretch are used."""
    sure: Share = 0.01
    """Relative deviation from which no other stretch of the video is asked."""
    stretches: Count = 4
    """Stretches of the video that are asked, at most, each after the one before it."""
    too_much: Share = 0.1
    """Relative deviation above which the focal length is not believed and the guess is kept."""
    min_parallax: Share = 0.02
    """Motion that rotation does not explain, needed between two keyframes, of the long edge."""
