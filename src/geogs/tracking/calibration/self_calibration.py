"""The lens of a video, from the video: what its stretches say, and a verdict."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool

from geogs.config import TrackingConfig
from geogs.geometry.camera import Camera
from geogs.threads import on_one_torch_thread
from geogs.tracking.calibration.degeneracy import Degeneracy
from geogs.tracking.calibration.growing_bundle import PlacedViews
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
    placed: PlacedViews | None = None
    """The views that told it."""


@on_one_torch_thread
def self_calibrate(
    frames: Iterable[Frame],
    camera: Camera,
    radial: bool = False,
    device: torch.device | str = "cpu",
    report: Report = lambda fraction: None,
    mask: Bool[np.ndarray, "h w"] | None = None,
    black_is_masked: bool = False,
    before: PlacedViews | None = None,
) -> SelfCalibration:
    """Estimate the focal length, k1 and k2 if ``radial``, of the camera that took ``frames``.

    ``camera`` is that of the frames. Its aspect and principal point are believed, its focal length
    is only one of several to start from. Flow is measured by the operator without a network.
    Stretch after stretch of the video is asked until one tells. Of frames that were straightened by
    what an earlier call found, only the views that it placed, ``before``, are asked again.
    ``report`` is called with the fraction done; what it raises passes through. Outside a ``mask``
    nothing is matched, nor what is quite black where ``black_is_masked``.
    """
    small = camera.with_long_edge(min(camera.long_edge, LONG_EDGE))
    size = small.width, small.height
    if mask is not None:
        mask = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    grid = SampleGrid(small, device)
    operator = build_operator(TrackingConfig(operator="classical"), grid, mask, black_is_masked)
    images = (cv2.resize(f.image, size, interpolation=cv2.INTER_AREA) for f in frames)
    gatherer = ViewGatherer(images, grid, operator)
    failures: list[str] = []
    tries = STRETCHES if before is None else 1
    while len(failures) < tries and not (failures and gatherer.is_over):
        stretch = Stretch(grid, operator, gatherer, radial, part_of(report, len(failures)))
        found = stretch.ask() if before is None else stretch.ask_again(before)
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
            placed=stretch.placed,
        )  # fmt: skip
    # That nothing explains a stretch weighs more than what the others lack.
    failure = min(failures, key=lambda said: said != Degeneracy.UNEXPLAINED.value)
    return SelfCalibration(camera, frames=gatherer.frames, failure=failure)


def part_of(report: Report, n: int) -> Report:
    """Report the n-th part as half of what is left, as nobody knows whether there is another."""
    return lambda done: report(1 - 0.5**n * (1 - done / 2))
