"""Unknown parameters of a camera before a run."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from jaxtyping import Bool, Float
from torch import Tensor

from geogs.bundle.row_motions import RowTimes
from geogs.camera.shutter.rolling_camera import RollingCamera

if TYPE_CHECKING:
    from geogs.tracking.calibration.view_gatherer import View


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
    velocity: Callable[["View"], tuple[Float[Tensor, "p 2"], Bool[Tensor, "p"]]]
    """Returns velocities of a view's cells in pixels per second, and where they are known."""
