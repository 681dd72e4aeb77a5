"""Self-calibration of a video's lens from stretches of the video, with a verdict.

The views of a stretch are located and adjusted together with the lens; its estimate has standard
deviations.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from geogs.bundle.lens import UNIT
from geogs.bundle.row_motions import RowTimes
from geogs.bundle.uncertainty.lens_error import STANDARD_ERRORS, LensEstimate
from geogs.camera.distortion import USUAL_BEND
from geogs.camera.shutter.rolling_camera import RollingCamera
from geogs.camera.shutter.shutter import FoundReadout
from geogs.config import TrackingConfig
from geogs.geometry.camera import Camera
from geogs.threads import on_one_torch_thread
from geogs.tracking.calibration.degeneracy import MAX_COST, MAX_RESIDUAL, Degeneracy, degeneracy
from geogs.tracking.calibration.focal_candidates import Start, candidates, try_candidate
from geogs.tracking.calibration.growing_bundle import GrowingBundle
from geogs.tracking.calibration.image_motions import TimedImage
from geogs.tracking.calibration.unknowns import OpenRows, Unknowns
from geogs.tracking.calibration.view_gatherer import View, ViewGatherer, flows_from_first
from geogs.tracking.flow.classical_flow import SMALL_IMAGE
from geogs.tracking.flow.flow_operator import FlowOperator
from geogs.tracking.flow.operator_choice import build_operator
from geogs.types import FlowMatch, Frame
from geogs.world.grid import SampleGrid

LONG_EDGE = 512
"""Largest long edge, in pixels, of the matched images, whatever the run tracks on; the limits of
parallax and of matched cells were chosen at it (docs/notebook/calibration.md)."""
STRETCHES = 3
"""Most stretches of the video that are tried, one after the other: bounds the time."""
START_KEYFRAMES = 12
"""Number of keyframes of a stretch solved first, and added each time it grows."""
KEYFRAMES = 24
"""Most keyframes of a stretch; they are added until the focal length is known well enough."""
MIN_PARALLAX = 0.003
"""Least motion not explained by rotation between two keyframes, as a fraction of the long edge:
some deviations of a match, enough to locate views. Whether it determines the focal length is shown
by the adjustment (docs/notebook/calibration.md)."""
LEAST_DEVIATION = 0.002
"""Least deviation of the focal length, relative, and of k1 and k2, however many matches agree."""
MOST_BEND = 4.0
"""Prior deviations of k1 and k2 beyond which an estimate is rejected as no real lens."""
_ASPECTS = 3
"""Most changes of the aspect before more views are added."""
UNRELIABLE = 0.1
"""Relative deviation above which the focal length is rejected and the guess, which may be as good,
is kept."""

Report = Callable[[float], None]


@dataclass(frozen=True)
class SelfCalibration:
    """Camera estimated from a video."""

    camera: Camera
    """Camera of the working image, with the aspect of the guess; the guess where there is a
    ``failure``."""
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
    squeeze: float = 1.0
    """Factor on fy over fx that the matches want: other than 1 where the pixels are no squares
    though nothing says so."""


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

    ``camera`` is that of the frames. Its principal point is assumed exact; its focal length, if
    unknown, is one of several initial values, and its aspect changes where another explains the
    matches much better. Flow is measured by the operator without a
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
    gatherer = ViewGatherer(images, grid, operator)
    rows = None
    if unknowns.rolling is not None:
        times = _row_times(unknowns.rolling, small)
        rows = OpenRows(times, gatherer.motions)
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
            (lens.k1, lens.k2) if bends else None,
            found.deviation,
            found.deviations[1:] if bends else None,
            found.keyframes,
            gatherer.frames,
            readout=found.readout or FoundReadout(),
            squeeze=round(lens.fy / lens.fx * small.fx / small.fy, 4),
        )
    # That no camera explains a stretch is more important than what the others lack.
    failure = min(failures, key=lambda failure: failure != Degeneracy.UNEXPLAINED.value)
    return SelfCalibration(camera, frames=gatherer.frames, failure=failure)


def _part_of(report: Report, n: int) -> Report:
    """Report the n-th part as half of the rest, as it is unknown whether there is another."""
    return lambda done: report(1 - 0.5**n * (1 - done / 2))


def _row_times(camera: RollingCamera, small: Camera) -> RowTimes:
    """Fit times of pixels of undistorted images by a plane."""
    coarse = small.with_long_edge(32)
    rays = coarse.rays(torch.float64).reshape(-1, 3)
    times = camera.line_times(camera.pixels(rays.numpy()))
    at = np.c_[small.pixels(rays[:, :2]).numpy(), np.ones(len(rays))]
    per_column, per_row, first = np.linalg.lstsq(at, times, rcond=None)[0].tolist()
    return RowTimes(per_column, per_row, first)


@dataclass(frozen=True)
class Estimate:
    """Lens estimated from one stretch."""

    lens: Camera
    covariance: Float64[Tensor, "3 3"]
    """Covariance of log focal length, k1 and k2; zero for those that are known."""
    keyframes: int
    readout: FoundReadout | None = None
    """None where it was not estimated, or images are too far apart to show it."""

    @property
    def deviations(self) -> tuple[float, float, float]:
        """Standard deviation of each of the three."""
        focal, k1, k2 = self.covariance.diagonal().sqrt().tolist()
        return focal, k1, k2

    @property
    def deviation(self) -> float:
        """Standard deviation of the focal length, relative."""
        return self.deviations[0]

    @property
    def is_precise(self) -> bool:
        """Whether no more keyframes are needed, as the focal length is known to 1 % and the readout
        to 3 ms: both are estimated again from all matches at the end of the run
        (docs/notebook/lens.md)."""
        if self.readout is not None and not self.readout.error < 0.003:
            return False
        return self.deviation < 0.01


@dataclass(eq=False)
class Stretch:
    """Consecutive views, from the gatherer's position on."""

    grid: SampleGrid
    operator: FlowOperator
    gatherer: ViewGatherer
    unknowns: Unknowns
    report: Report
    rows: OpenRows | None = None
    """Rows of a possibly rolling shutter."""
    _views: list[View] = field(default_factory=list, init=False)
    _done: float = field(default=0.0, init=False)

    def _tick(self) -> None:
        """Report progress; called at every frame."""
        self.report(self._done)

    def _gather(self, count: int) -> bool:
        """Gather views; return whether there are more than before."""
        before = len(self._views)
        self._views = self.gatherer.gather(self._views, count, self._tick)
        return len(self._views) > before

    def ask(self) -> Estimate | str:
        """Locate and adjust more and more views until the focal length is known; return the
        estimate, or the reason why there is none."""
        start = self._start()
        if isinstance(start, Degeneracy):
            return start.value
        bundle = GrowingBundle(
            self.grid, self.operator, self._views, start, self.unknowns, self.rows
        )
        found: Estimate | str = "its motion could not be followed"
        while True:
            for view in self._views[len(bundle) :]:
                self._tick()
                if not bundle.place(view):
                    return found
            if not self._adjust(bundle):
                return found
            for _ in range(_ASPECTS):
                if not (self.unknowns.focal and bundle.find_aspect()):
                    break
                if not self._adjust(bundle):
                    return found
            found = estimate(bundle, self.unknowns)
            self._done = 0.3 + 0.7 * min(1.0, len(bundle) / KEYFRAMES)
            if isinstance(found, Estimate) and found.is_precise:
                return found
            if not self._gather(min(len(bundle) + START_KEYFRAMES, KEYFRAMES)):
                return found

    def _adjust(self, bundle: GrowingBundle) -> bool:
        """Match and adjust all views; False if that fails. Matches are searched again from their
        positions after the first adjustment."""
        for fine in (self.grid.camera.long_edge <= SMALL_IMAGE, True):
            bundle.measure(fine, self._tick)
            if not bundle.adjust():
                return False
        return True

    def _start(self) -> Start | Degeneracy:
        """Return the first views with parallax and depth, located with the best candidate."""
        failure = Degeneracy.BLANK
        while failure is not Degeneracy.UNEXPLAINED and self._gather(START_KEYFRAMES):
            if len(self._views) < 4:
                return Degeneracy.STILL
            flows = flows_from_first(self.grid, self.operator, self._views)
            found = self._solve_start(flows)
            if isinstance(found, Start):
                self._done = 0.3
                return found
            failure = found
            # Later views may show more.
            self._views = self._views[len(self._views) // 2 :]
        return failure

    def _solve_start(self, flows: list[FlowMatch]) -> Start | Degeneracy:
        camera = self.grid.camera
        min_parallax = MIN_PARALLAX * camera.long_edge
        wrong = degeneracy(camera, flows, min_parallax)
        if wrong is not None and (self.unknowns.focal or wrong is not Degeneracy.PLANAR):
            return wrong
        # One after the other: in parallel their many small operations would wait for Python.
        starts = (
            try_candidate(lens, flows, min_parallax, self.unknowns)
            for lens in candidates(camera, self.unknowns)
        )
        found = [s for s in starts if s is not None]
        if not found:
            return Degeneracy.TURNING
        best = min(found, key=lambda s: s.penalised)
        # A rolling shutter is not modelled yet.
        is_explained = best.cost <= MAX_COST or self.rows is not None
        return best if is_explained else Degeneracy.UNEXPLAINED


def estimate(bundle: GrowingBundle, unknowns: Unknowns) -> Estimate | str:
    """Return the estimate from an adjusted stretch, or why it is rejected."""
    result = bundle.result
    assert result is not None
    lens = result.block.lens
    angle = 2 * math.degrees(math.atan(lens.long_edge / 2 / lens.fx))
    if not 15 < angle < 150:  # degrees, along the longer side
        return f"it seems to have a field of view of {angle:.0f} degrees"
    bends = zip((lens.k1, lens.k2), USUAL_BEND, strict=True)
    if any(abs(k) > MOST_BEND * usual for k, usual in bends):
        return "its lens seems to bend as none does"
    if unknowns.focal and bundle.residual > MAX_RESIDUAL:
        return Degeneracy.UNEXPLAINED.value
    estimated = torch.tensor([unknowns.focal, unknowns.radial, unknowns.radial]).double()
    whole = STANDARD_ERRORS**2 * result.covariance
    covariance = whole[:3, :3] + LEAST_DEVIATION**2 * estimated.diag()
    readout = None
    if result.block.rolls:
        readout = FoundReadout(result.block.readout, UNIT * float(whole[3, 3].sqrt()))
    found = with_prior(Estimate(lens, covariance, len(bundle), readout))
    if found.deviation < UNRELIABLE:
        return found
    return f"its motion leaves the focal length unsure by {100 * found.deviation:.0f} %"


def with_prior(found: Estimate) -> Estimate:
    """Combine an estimate with the prior that k1 and k2 are about zero, as a narrow field of view
    does not determine them."""
    lens = found.lens
    size = torch.tensor([0.0, lens.k1, lens.k2], dtype=torch.float64)
    with_both = LensEstimate(size, found.covariance)
    for n, deviation in enumerate(USUAL_BEND, 1):
        with_both = with_both.told(n, 0.0, deviation)
    moved = lens.moved(*(with_both.size - size).tolist())
    return replace(found, lens=moved, covariance=with_both.covariance)
