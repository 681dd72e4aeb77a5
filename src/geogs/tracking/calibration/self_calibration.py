"""The lens of a video, from the video: what its stretches say, and a verdict."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool

from geogs.bundle.row_motions import RowTimes
from geogs.camera.shutter.rolling_camera import RollingCamera
from geogs.config import TrackingConfig
from geogs.geometry.camera import Camera
from geogs.threads import on_one_torch_thread
from geogs.tracking.calibration.degeneracy import Degeneracy
from geogs.tracking.calibration.growing_bundle import OpenRows
from geogs.tracking.calibration.image_motions import TimedImage
from geogs.tracking.calibration.stretch import Report, Stretch
from geogs.tracking.calibration.view_gatherer import ViewGatherer
from geogs.tracking.flow.operator_choice import build_operator
from geogs.types import Frame
from geogs.world.grid import SampleGrid

LONG_EDGE = 512
"""Pixels of the images that are matched, at most, whatever the run tracks on: what the limits of
parallax and of matched cells were chosen at (docs/notebook/calibration.md)."""
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


@on_one_torch_thread
def self_calibrate(
    frames: Iterable[Frame],
    camera: Camera,
    radial: bool = False,
    device: torch.device | str = "cpu",
    report: Report = lambda fraction: None,
    mask: Bool[np.ndarray, "h w"] | None = None,
    black_is_masked: bool = False,
    rolling: RollingCamera | None = None,
    readout: float | None = None,
) -> SelfCalibration:
    """Estimate the focal length, k1 and k2 if ``radial``, of the camera that took ``frames``.

    ``camera`` is that of the frames. Its aspect and principal point are believed, its focal length
    is only one of several to start from. Flow is measured by the operator without a network.
    Stretch after stretch of the video is asked until one tells. Rows of a ``rolling`` camera, as
    they came, are seen over a ``readout`` of so many seconds, or one that is estimated with the
    lens: what rows shear and stretch passes for another lens otherwise. ``report`` is called with
    the fraction done; what it raises passes through. Outside a ``mask`` nothing is matched, nor
    what is quite black where ``black_is_masked``.
    """
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
    if rolling is not None:
        rows = OpenRows(_row_times(rolling, small), gatherer.velocity, readout)
    failures: list[str] = []
    while len(failures) < STRETCHES and not (failures and gatherer.is_over):
        part = _part_of(report, len(failures))
        found = Stretch(grid, operator, gatherer, radial, part, rows).ask()
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
        )  # fmt: skip
    # That nothing explains a stretch weighs more than what the others lack.
    failure = min(failures, key=lambda said: said != Degeneracy.UNEXPLAINED.value)
    return SelfCalibration(camera, frames=gatherer.frames, failure=failure)


def _part_of(report: Report, n: int) -> Report:
    """Report the n-th part as half of what is left, as nobody knows whether there is another."""
    return lambda done: report(1 - 0.5**n * (1 - done / 2))


def _row_times(camera: RollingCamera, size: Camera) -> RowTimes:
    """When pixels of images of another size are seen."""
    seen_by = replace(camera, camera=size)
    first, right, below = seen_by.line_times(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
    return RowTimes(float(right - first), float(below - first), float(first))
