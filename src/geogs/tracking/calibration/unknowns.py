"""Unknown parameters of a camera before a run."""

from dataclasses import dataclass

from geogs.bundle.row_motions import RowTimes
from geogs.camera.shutter.rolling_camera import RollingCamera
from geogs.tracking.calibration.image_motions import ImageMotions


@dataclass(frozen=True)
class Unknowns:
    """Parameters of a camera to be estimated from its video."""

    focal: bool = True
    """Whether the focal length is estimated."""
    radial: bool = False
    """Whether k1 and k2 are estimated."""
    rolling: RollingCamera | None = None
    """Camera with its readout direction; None for a global shutter."""
    readout: float | None = None
    """Readout in seconds; estimated if it is None and the camera is ``rolling``."""


@dataclass(frozen=True)
class OpenRows:
    """Rows of a rolling shutter in images that were not rectified."""

    times: RowTimes
    motions: ImageMotions
    """Velocities of the views' cells in the images."""
