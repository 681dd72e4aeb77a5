"""The focal length of a video, from the video: keyframes, a start, adjustment, and a verdict."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool

from geogs.config import CalibrationConfig, TrackingConfig
from geogs.geometry.camera import Camera
from geogs.keyframes.grid import SampleGrid
from geogs.threads import on_one_torch_thread, thread_map
from geogs.tracking.calibration.degeneracy import Degeneracy, degeneracy
from geogs.tracking.calibration.growth import GrowingBundle
from geogs.tracking.calibration.keyframes import View, ViewGatherer, flows_from_first
from geogs.tracking.calibration.start import Start, candidates, try_candidate
from geogs.tracking.flow.base import FlowMatch, FlowOperator
from geogs.tracking.flow.masked import MaskedFlow
from geogs.tracking.flow.painted import PaintedFlow
from geogs.tracking.flow.select import build_operator
from geogs.types import Frame

LEAST_VIEWS = 4
STANDARD_ERRORS = 3.0
"""The adjustment's own standard error times this is taken for the deviation: matches of different
keyframes err alike too. Measured on rendered rooms, where errors are 1 to 7 standard errors."""
LEAST_DEVIATION = 0.002
"""Relative: no focal length is surer than this, however many matches agree."""
DISTORTION_SHARE = 0.5
"""Of the change of the focal length when k1 is free too: counts as deviation where it is not."""
FIELDS_OF_VIEW = 15.0, 150.0
"""Degrees along the longer side; what lies outside is no pinhole camera's."""
MAX_COST = 6.0
"""Mean cost of a match, in variances, above which no pinhole camera explains the flow."""

Report = Callable[[float], None]


@dataclass(frozen=True)
class SelfCalibration:
    """What the video says of its camera."""

    camera: Camera
    """Of the working image; the guess where there is a ``failure``."""
    k1: float = 0.0
    deviation: float = math.inf
    """Standard deviation of the focal length, as a share of it."""
    deviation_k1: float | None = None
    """Standard deviation of k1; none where it was not asked for."""
    keyframes: int = 0
    frames: int = 0
    """Looked at."""
    failure: str | None = None
    """Why the video does not tell; "the camera only turns", for the middle of a sentence."""


@on_one_torch_thread
def self_calibrate(
    frames: Iterable[Frame],
    camera: Camera,
    config: CalibrationConfig,
    device: torch.device | str = "cpu",
    seed: int = 0,
    report: Report = lambda fraction: None,
    mask: Bool[np.ndarray, "h w"] | None = None,
    black_is_hidden: bool = False,
) -> SelfCalibration:
    """Estimate the focal length, and k1 if ``config.radial``, of the camera that took ``frames``.

    Aspect and principal point of ``camera`` are believed, its focal length is only one of several
    to start from. Flow is measured by the operator without a network. ``report`` is called with
    the fraction done; what it raises passes through. Outside a ``mask`` nothing is matched,
    nor what is quite black where ``black_is_hidden``.
    """
    cv2.setRNGSeed(seed)
    grid = SampleGrid(camera, device)
    operator = build_operator(TrackingConfig(operator="classical"), grid)
    if mask is not None:
        operator = MaskedFlow(operator, grid, mask)
    if black_is_hidden:
        operator = PaintedFlow(operator, grid)
    edge = max(camera.width, camera.height)
    gatherer = ViewGatherer(iter(frames), grid, operator, config.keyframe_flow * edge)
    search = _Search(grid, operator, gatherer, config, report)
    start = search.start()
    if isinstance(start, Degeneracy):
        return SelfCalibration(camera, frames=gatherer.frames, failure=start.value)
    bundle = search.grow(start)
    if bundle is None:
        failure = "its motion could not be followed"
        return SelfCalibration(camera, frames=gatherer.frames, failure=failure)
    report(1.0)
    return _verdict(camera, config, bundle, gatherer.frames)


class _Search:
    """One estimation; keeps the views."""

    def __init__(
        self,
        grid: SampleGrid,
        operator: FlowOperator,
        gatherer: ViewGatherer,
        config: CalibrationConfig,
        report: Report,
    ) -> None:
        self.grid, self.operator, self.config = grid, operator, config
        self._gatherer, self._report = gatherer, report
        self._views: list[View] = []
        self._done = 0.0
        edge = max(grid.camera.width, grid.camera.height)
        self._min_parallax = config.min_parallax * edge

    def _tick(self) -> None:
        """Every frame is a safe point."""
        self._report(self._done)

    def _gather(self, count: int) -> bool:
        """Whether there are more views than before."""
        before = len(self._views)
        self._views = self._gatherer.gather(self._views, count, self.config.frames, self._tick)
        return len(self._views) > before

    def start(self) -> Start | Degeneracy:
        """The first views that show parallax and depth, placed by the best candidate."""
        count = max(self.config.start_keyframes, 2 * LEAST_VIEWS)
        failure = Degeneracy.BLANK
        while self._gather(count):
            if len(self._views) < LEAST_VIEWS:
                return Degeneracy.STILL
            flows = flows_from_first(self.grid, self.operator, self._views)
            found = self._solve_start(flows)
            if isinstance(found, Start):
                self._done = 0.3
                return found
            failure = found
            # What comes later may show more.
            self._views = self._views[len(self._views) // 2 :]
        return failure

    def _solve_start(self, flows: list[FlowMatch]) -> Start | Degeneracy:
        camera = self.grid.camera
        wrong = degeneracy(camera, flows, self._min_parallax)
        if wrong is not None:
            return wrong
        starts = thread_map(
            lambda c: try_candidate(c, flows, self._min_parallax), candidates(camera)
        )
        found = [s for s in starts if s is not None]
        return min(found, key=lambda s: s.cost) if found else Degeneracy.TURNING

    def grow(self, start: Start) -> GrowingBundle | None:
        """Adjust, with more keyframes until the focal length is sure; None if it fails at once."""
        config, bundle = self.config, GrowingBundle(self.grid, self.operator, self._views, start)
        best = None
        while True:
            for view in self._views[len(bundle) :]:
                self._tick()
                if not bundle.place(view):
                    return best
            for fine in (False, True):
                bundle.measure(fine, self._tick)
                if not bundle.adjust(config.radial):
                    return best
            best = bundle
            self._done = 0.3 + 0.7 * min(1.0, len(bundle) / config.keyframes)
            if relative_error(bundle) < config.enough or len(bundle) >= config.keyframes:
                return best
            if not self._gather(min(len(bundle) + config.start_keyframes, config.keyframes)):
                return best


def relative_error(bundle: GrowingBundle) -> float:
    """Deviation of the focal length by the matches alone, as a share of it."""
    assert bundle.result is not None
    error = STANDARD_ERRORS * math.sqrt(float(bundle.result.covariance[0, 0]))
    return math.hypot(error, LEAST_DEVIATION)


def _verdict(
    guess: Camera, config: CalibrationConfig, bundle: GrowingBundle, frames: int
) -> SelfCalibration:
    """The estimate, or why it is not believed."""
    result = bundle.result
    assert result is not None
    deviation = relative_error(bundle)
    if not config.radial:
        other = bundle.solve(radial=True)
        shift = math.log(other.block.lens.camera.fx / result.block.lens.camera.fx)
        deviation = math.hypot(deviation, DISTORTION_SHARE * shift)
    lens = result.block.lens
    camera = lens.camera
    angle = 2 * math.degrees(math.atan(max(camera.width, camera.height) / 2 / camera.fx))
    failure = None
    if not deviation < config.too_much:
        failure = f"its motion leaves the focal length unsure by {100 * deviation:.0f} %"
    elif not FIELDS_OF_VIEW[0] < angle < FIELDS_OF_VIEW[1]:
        failure = f"it seems to have a field of view of {angle:.0f} degrees"
    elif result.cost > MAX_COST:
        failure = "no pinhole camera explains its motion"
    if failure is not None:
        return SelfCalibration(guess, keyframes=len(bundle), frames=frames, failure=failure)
    error_k1 = STANDARD_ERRORS * math.sqrt(float(result.covariance[1, 1]))
    deviation_k1 = error_k1 if config.radial else None
    return SelfCalibration(camera, lens.k1, deviation, deviation_k1, len(bundle), frames)
