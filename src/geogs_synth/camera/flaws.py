"""Flaws of a real camera, as numbers; every flaw is off by default."""

from dataclasses import dataclass
from typing import Annotated, Literal

from geogs.config.setting import Fraction, Range, Settings

CameraKind = Literal["clean", "phone", "kinect", "action"]
"""Cameras with typical flaws."""


@dataclass(frozen=True)
class Flaws(Settings, group="flaws"):
    """The flaws of a camera."""

    readout: Annotated[float, Range(0, 0.1)] = 0.0
    """Seconds from the first to the last row of a rolling shutter; 0 takes all rows at once."""
    exposure: Annotated[float, Range(0, 0.1)] = 0.0
    """Seconds over which each row gathers light, which blurs what moves."""
    noise: Annotated[float, Range(0, 50)] = 0.0
    """Standard deviation of the sensor's noise in grey levels of 255."""
    gain_drift: Annotated[float, Range(0, 3)] = 0.0
    """Stops by which the automatic exposure wanders to either side, within a few seconds."""
    colour_drift: Annotated[float, Range(0, 0.5)] = 0.0
    """Fraction by which the white balance wanders between red and blue."""
    vignetting: Fraction = 0.0
    """Fraction of the light that is lost in the corners."""
    jpeg: Annotated[int, Range(1, 100)] | None = None
    """Quality of JPEG that the image goes through; none writes it as the format does."""
    k1: Annotated[float, Range(-0.5, 0.5)] = 0.0
    """Radial distortion, OpenCV's first coefficient; it is written with the intrinsics."""
    k2: Annotated[float, Range(-0.5, 0.5)] = 0.0
    """Radial distortion, OpenCV's second coefficient."""
    focusing: Annotated[float, Range(0, 0.2)] = 0.0
    """Part by which the focal length changes to either side, within a second or two, as the camera
    focuses; the intrinsics are those in the middle."""
    stabilisation: Annotated[float, Range(0, 0.1)] = 0.0
    """Focal lengths by which the principal point is moved to either side against a hand's shake."""


_TYPICAL: dict[CameraKind, Flaws] = {
    "phone": Flaws(
        readout=0.02, exposure=0.01, noise=2.0, gain_drift=0.3, colour_drift=0.04, vignetting=0.25,
        jpeg=88, k1=0.06, k2=-0.1,
    ),
    "kinect": Flaws(
        readout=0.027, exposure=0.016, noise=3.0, gain_drift=0.3, colour_drift=0.06,
        vignetting=0.15, jpeg=85, k1=0.1, k2=-0.2,
    ),
    "action": Flaws(
        readout=0.012, exposure=0.005, noise=2.5, gain_drift=0.4, colour_drift=0.04,
        vignetting=0.45, jpeg=80, k1=-0.25, k2=0.06,
    ),
}  # fmt: skip


def camera_flaws(kind: CameraKind) -> Flaws:
    """The flaws of a phone, of a depth sensor's colour camera, of an action camera, or none."""
    return _TYPICAL.get(kind, Flaws())
