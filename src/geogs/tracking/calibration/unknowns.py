"""What of a camera is not known before a run."""

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
    """The numbers of a camera that its video is asked for."""

    focal: bool = True
    """Whether the focal length is estimated."""
    radial: bool = False
    """Whether k1 and k2 are estimated."""
    rolling: RollingCamera | None = None
    """The camera as its lines are read; none of a global shutter."""
    readout: float | None = None
    """Seconds of its readout; estimated where it is none and the camera is ``rolling``."""


@dataclass(frozen=True)
class OpenRows:
    """Rows of a rolling shutter in images as they came."""

    times: RowTimes
    velocity: Callable[["View"], tuple[Float[Tensor, "p 2"], Bool[Tensor, "p"]]]
    """Pixels per second of what the cells of a view show, and where they are known."""
    readout: float | None = None
    """Seconds, where it is known."""
