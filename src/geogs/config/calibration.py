"""Settings of self-calibration."""

from dataclasses import dataclass


@dataclass(frozen=True)
class CalibrationConfig:
    """How intrinsics that nobody gave are found from the video itself.

    Intrinsics that the user or a data set gives are never changed.
    """

    refine: bool = True
    """Whether a guessed focal length, or one from EXIF, is refined before the run."""
    radial: bool = False
    """Also find one radial distortion term (OpenCV's k1) and undistort the images by it."""
    frames: int = 600
    """Frames of the video that are looked at, at most."""
    start_keyframes: int = 12
    """Keyframes that are solved first, at least 8."""
    keyframes: int = 36
    """Most keyframes that are used; they are added until the focal length is sure enough."""
    keyframe_flow: float = 0.025
    """Median motion that makes a frame a keyframe, of the long edge."""
    enough: float = 0.0021
    """Relative deviation of the focal length that ends the search early."""
    too_much: float = 0.1
    """Relative deviation above which the focal length is not believed and the guess is kept."""
    min_parallax: float = 0.02
    """Motion that rotation does not explain, needed between two keyframes, of the long edge."""
