"""Self-calibration of a video's lens from stretches of the video, with a verdict."""

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
"""Largest long edge, in pixels, of the matched images, whatever the run tracks on; the limits of
parallax and of matched cells were chosen at it (docs/notebook/calibration.md)."""
TIMED = 32
"""Long edge, in pixels, of the grid on which times of pixels are computed."""
STRETCHES = 3
"""Most stretches of the video that are tried, one after the other: bounds the time."""


@dataclass(frozen=True)
class SelfCalibration:
    """Camera estimated from a video."""

    camera: Camera
    """Camera of the working image; the guess where there is a ``failure``."""
    distortion: tuple[float, float] | None = None
    """OpenCV's k1 and k2; None where they were not estimated, or the video does not show any
    distortion."""
    deviation: float = math.inf
    """Standard deviation of the focal length, relative."""
    deviations: tuple[float, float] | None = None
    """Standard deviations of k1 and k2."""
    keyframes: int = 0
    frames: int = 0
    """Number of frames used."""
    failure: str | None = None
    """Reason of a failure, such as "the camera only turns", for the middle of a sentence."""
    readout: FoundReadout = field(default_factory=FoundReadout)
    """Readout of its shutter, if it was estimated."""


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
    """Estimate the ``unknowns`` (default: the focal length) of the camera that took ``frames``,
    whose rows are not rectified.

    ``camera`` is that of the frames. Its aspect and principal point are assumed exact; its focal
    length, if unknown, is one of several initial values. Flow is measured by the operator without a
    network. Stretches of the video are tried until one succeeds. Lens and readout are estimated
    together, as shear and stretch by rows would be mistaken for another lens.
    ``report`` is called with the fraction done; its exceptions are passed on. Pixels outside a
    ``mask`` are not matched, nor black ones with ``black_is_masked``.
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
        rows = OpenRows(times, gatherer.velocity)
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
    # That no camera explains a stretch is more important than what the others lack.
    failure = min(failures, key=lambda said: said != Degeneracy.UNEXPLAINED.value)
    return SelfCalibration(camera, frames=gatherer.frames, failure=failure)


def _part_of(report: Report, n: int) -> Report:
    """Report the n-th part as half of the rest, as it is unknown whether there is another."""
    return lambda done: report(1 - 0.5**n * (1 - done / 2))


def _row_times(camera: RollingCamera, small: Camera) -> RowTimes:
    """Fit times of pixels of undistorted images by a plane."""
    rays = small.with_long_edge(TIMED).rays(torch.float64).reshape(-1, 3)
    times = camera.line_times(camera.pixels(rays.numpy()))
    at = np.c_[small.pixels(rays[:, :2]).numpy(), np.ones(len(rays))]
    per_column, per_row, first = np.linalg.lstsq(at, times, rcond=None)[0].tolist()
    return RowTimes(per_column, per_row, first)
