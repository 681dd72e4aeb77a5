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
from geogs.tracking.calibration.focal_uncertainty import Estimate
from geogs.tracking.calibration.stretch import Report, Stretch
from geogs.tracking.calibration.view_gatherer import ViewGatherer, distant_flows
from geogs.tracking.calibration.view_graph import view_graph_estimate
from geogs.tracking.flow.operator_choice import build_operator
from geogs.types import Frame
from geogs.world.grid import SampleGrid

LONG_EDGE = 512
"""Pixels of the images that are matched, at most, whatever the run tracks on: what the limits of
parallax and of matched cells were chosen at (docs/calibration.md)."""
STRETCHES = 4
"""Stretches of the video that are used, at most, each after the one before it: bounds the time."""
CONFIDENT = 0.03
"""Relative deviation of the focal length from which no other stretch is asked."""
UNRELIABLE = 0.1
"""Relative deviation above which the focal length is not believed and the guess is kept, which may
be as good."""


@dataclass(frozen=True)
class SelfCalibration:
    """What the video says of its camera."""

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
    """That were used."""
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
) -> SelfCalibration:
    """Estimate the focal length, k1 and k2 if ``radial``, of the camera that took ``frames``.

    ``camera`` is that of the frames. Its aspect and principal point are believed, its focal length
    is only one of several to start from. Flow is measured by the operator without a network.
    Stretch after stretch of the video is asked until one is confident, and the surest counts; where
    none tells, the epipolar geometry of distant pairs of their views is asked. ``report`` is called
    with the fraction done; what it raises passes through. Outside a ``mask`` nothing is matched,
    nor what is quite black where ``black_is_masked``.
    """
    small = camera.with_long_edge(min(camera.long_edge, LONG_EDGE))
    size = small.width, small.height
    if mask is not None:
        mask = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    grid = SampleGrid(small, device)
    operator = build_operator(TrackingConfig(operator="classical"), grid, mask, black_is_masked)
    images = (cv2.resize(f.image, size, interpolation=cv2.INTER_AREA) for f in frames)
    gatherer = ViewGatherer(images, grid, operator)
    best: Estimate | None = None
    failure = ""
    for n in range(STRETCHES):
        said = Stretch(grid, operator, gatherer, radial, _part_of(report, n)).ask()
        if isinstance(said, str):
            failure = failure or said
        elif best is None or said.deviation < best.deviation:
            best = said
        if gatherer.is_over or (best is not None and best.deviation < CONFIDENT):
            break
    found = None if best is None else best.as_told()
    if found is None or not found.deviation < UNRELIABLE:
        asked = _part_of(report, STRETCHES)
        flows = distant_flows(grid, operator, gatherer.views, lambda: asked(0.0))
        by_pairs = view_graph_estimate(small, flows)
        if by_pairs is not None and by_pairs.deviation < UNRELIABLE:
            found = by_pairs
    if found is None:
        return SelfCalibration(camera, frames=gatherer.frames, failure=failure)
    report(1.0)
    return _verdict(camera, small, found, gatherer.frames)


def _part_of(report: Report, n: int) -> Report:
    """Report the n-th stretch as half of what is left, as nobody knows whether there is another."""
    return lambda done: report(1 - 0.5**n * (1 - done / 2))


def _verdict(guess: Camera, small: Camera, found: Estimate, frames: int) -> SelfCalibration:
    """The estimate on images of ``small``, for those of the guess, or why it is not believed."""
    if not found.deviation < UNRELIABLE:
        failure = f"its motion leaves the focal length unsure by {100 * found.deviation:.0f} %"
        return SelfCalibration(guess, keyframes=found.keyframes, frames=frames, failure=failure)
    k1, k2 = found.lens.k1, found.lens.k2
    bends = k1 != 0 or k2 != 0
    camera = guess.with_focal(guess.fx * found.camera.fx / small.fx)
    return SelfCalibration(
        camera, (k1, k2) if bends else None, found.deviation,
        found.deviations[1:] if bends else None, found.keyframes, frames,
    )  # fmt: skip
