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
    """Readout of the rolling shutter from first row to last, seconds; 0 is a global shutter."""
    exposure: Annotated[float, Range(0, 0.1)] = 0.0
    """Exposure time of each row, seconds; it blurs what moves."""
    noise: Annotated[float, Range(0, 50)] = 0.0
    """Standard deviation of the sensor's noise, in 8-bit grey levels."""
    gain_drift: Annotated[float, Range(0, 3)] = 0.0
    """Amplitude of the drift of the automatic exposure over a few seconds, stops."""
    colour_drift: Annotated[float, Range(0, 0.5)] = 0.0
    """Amplitude of the drift of the white balance between red and blue, a fraction of the gain."""
    vignetting: Fraction = 0.0
    """Fraction of the light lost in the corners."""
    jpeg: Annotated[int, Range(1, 100)] | None = None
    """JPEG quality at which the camera compresses; none leaves that to the image format."""
    k1: Annotated[float, Range(-0.5, 0.5)] = 0.0
    """First coefficient of OpenCV's radial distortion, written with the intrinsics."""
    k2: Annotated[float, Range(-0.5, 0.5)] = 0.0
    """Second coefficient of OpenCV's radial distortion, written with the intrinsics."""
    focusing: Annotated[float, Range(0, 0.2)] = 0.0
    """Amplitude of the change of the focal length by focusing, a fraction of it, within a second or
    two; the intrinsics written are the mean."""
    stabilisation: Annotated[float, Range(0, 0.1)] = 0.0
    """Amplitude of the principal point's motion by optical stabilisation, in focal lengths."""


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
