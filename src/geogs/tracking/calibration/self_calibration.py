"""The lens of a video, from the video: what its stretches say, and a verdict."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import cv2
import numpy as np
import torch
from jaxtyping import Bool

from geogs.bundle.row_motions import RowTimes
from geogs.camera.shutter.readout import FoundReadout
from geogs.camera.shutter.rolling_camera import RollingCamera
from geogs.config import TrackingConfig
from geogs.geometry.camera import Camera
from geogs.threads import on_one_torch_thread
from geogs.tracking.calibration.degeneracy import Degeneracy
from geogs.tracking.calibration.image_motions import TimedImage
from geogs.tracking.calibration.stretch import Report, Stretch
from geogs.tracking.calibration.unknowns import OpenRows, Unknowns
from geogs.tracking.calibration.view_gatherer import ViewGatherer
from geogs.tracking.flow.operator_choice import build_operator
from geogs.types import Frame
from geogs.world.grid import SampleGrid

LONG_EDGE = 512
"""Pixels of the images that are matched, at most, whatever the run tracks on: what the limits of
parallax and of matched cells were chosen at (docs/notebook/calibration.md)."""
TIMED = 32
"""Pixels of the long edge of the grid on which it is asked when pixels are seen."""
STRETCHES = 3
"""Stretches of the video that are asked, at most, each after the one before it: bounds the time."""


@dataclass(frozen=True)
class SelfCalibration:
    """The camera of a video, as far as the video tells it."""

    camera: Camera
    """Camera of the working image; the guess where there is a ``failure``."""
    distortion: tuple[float, float] | None = None
    """OpenCV's k1 and k2; none where they were not asked for, or the video does not tell that the
    lens bends."""
    deviation: float = math.inf
    """Standard deviation of the focal length, relative."""
    deviations: tuple[float, float] | None = None
    """Standard deviations of k1 and k2."""
    keyframes: int = 0
    frames: int = 0
    """Frames that were used."""
    failure: str | None = None
    """Why the video does not tell; "the camera only turns", for the middle of a sentence."""
    readout: FoundReadout = field(default_factory=FoundReadout)
    """Of its shutter, as far as the video tells it where it was asked for it."""


@on_one_torch_thread
def self_calibrate(
    frames: Iterable[Frame],
    camera: Camera,
    unknowns: Unknowns | None = None,
    device: torch.device | str = "cpu",
    report: Report = lambda fraction: None,
    mask: Bool[np.ndarray, "h w"] | None = None,
    black_is_masked: bool = False,
) -> SelfCalibration:
    """Estimate what is not known of the camera that took ``frames``, their rows as they came: the
    focal length alone where no ``unknowns`` are named.

    ``camera`` is that of the frames. Its aspect and principal point are believed; its focal length,
    where that is unknown, is only one of several to start from. Flow is measured by the operator
    without a network. Stretch after stretch of the video is asked until one tells. Lens and readout
    are estimated together: what rows shear and stretch passes for another lens otherwise.
    ``report`` is called with the fraction done; what it raises passes through. Outside a ``mask``
    nothing is matched, nor what is quite black where ``black_is_masked``.
    """
    unknowns = unknowns or Unknowns()
    small = camera.with_long_edge(min(camera.long_edge, LONG_EDGE))
    size = small.width, small.height
    if mask is not None:
        mask = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    grid = SampleGrid(small, device)
    operator = build_operator(TrackingConfig(operator="classical"), grid, mask, black_is_masked)
    images = (
        TimedImage(f.timestamp, cv2.resize(f.image, size, interpolation=cv2.INTER_AREA))
        for f in frames
    )
    gatherer, rows = ViewGatherer(images, grid, operator), None
    if unknowns.rolling is not None:
        times = _row_times(unknowns.rolling, small)
        rows = OpenRows(times, gatherer.velocity, unknowns.readout)
    failures: list[str] = []
    while len(failures) < STRETCHES and not (failures and gatherer.is_over):
        part = _part_of(report, len(failures))
        found = Stretch(grid, operator, gatherer, unknowns, part, rows).ask()
        if isinstance(found, str):
            failures.append(found)
            continue
        report(1.0)
        lens = found.lens
        bends = lens.k1 != 0 or lens.k2 != 0
        return SelfCalibration(
            camera.with_focal(camera.fx * lens.fx / small.fx),
            (lens.k1, lens.k2) if bends else None, found.deviation,
            found.deviations[1:] if bends else None, found.keyframes, gatherer.frames,
            readout=found.readout or FoundReadout(),
        )  # fmt: skip
    # That nothing explains a stretch weighs more than what the others lack.
    failure = min(failures, key=lambda said: said != Degeneracy.UNEXPLAINED.value)
    return SelfCalibration(camera, frames=gatherer.frames, failure=failure)


def _part_of(report: Report, n: int) -> Report:
    """Report the n-th part as half of what is left, as nobody knows whether there is another."""
    return lambda done: report(1 - 0.5**n * (1 - done / 2))


def _row_times(camera: RollingCamera, small: Camera) -> RowTimes:
    """When pixels of undistorted images are seen: the plane that comes nearest."""
    rays = small.with_long_edge(TIMED).rays(torch.float64).reshape(-1, 3)
    times = camera.line_times(camera.pixels(rays.numpy()))
    at = np.c_[small.pixels(rays[:, :2]).numpy(), np.ones(len(rays))]
    per_column, per_row, first = np.linalg.lstsq(at, times, rcond=None)[0].tolist()
    return RowTimes(per_column, per_row, first)
