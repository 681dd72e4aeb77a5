"""One stretch of a video whose views are located and adjusted together with the lens."""

from collections.abc import Callable

from geogs.tracking.calibration.degeneracy import MAX_COST, Degeneracy, degeneracy
from geogs.tracking.calibration.focal_candidates import Start, candidates, try_candidate
from geogs.tracking.calibration.focal_uncertainty import Estimate, estimate
from geogs.tracking.calibration.growing_bundle import GrowingBundle
from geogs.tracking.calibration.unknowns import OpenRows, Unknowns
from geogs.tracking.calibration.view_gatherer import View, ViewGatherer, flows_from_first
from geogs.tracking.flow.flow_operator import FlowOperator
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid

START_KEYFRAMES = 12
"""Number of keyframes of a stretch solved first, and added each time it grows."""
KEYFRAMES = 24
"""Most keyframes of a stretch; they are added until the focal length is known well enough."""
ENOUGH_DEVIATION, ENOUGH_ERROR = 0.01, 0.003
"""Relative deviation of the focal length, and deviation of the readout in seconds, below which a
stretch needs no more keyframes: both are estimated again from all matches at the end of the run
(docs/notebook/lens.md)."""
SMALL_IMAGE = 400
"""Long edge, in pixels, up to which images are matched at full resolution from the start; larger
ones at half of it first."""
MIN_PARALLAX = 0.003
"""Least motion not explained by rotation between two keyframes, as a fraction of the long edge:
some deviations of a match, enough to locate views. Whether it determines the focal length is shown
by the adjustment (docs/notebook/calibration.md)."""
MIN_VIEWS = 4
NOT_FOLLOWED = "its motion could not be followed"

Report = Callable[[float], None]


class Stretch:
    """Consecutive views, from the gatherer's position on."""

    def __init__(
        self,
        grid: SampleGrid,
        operator: FlowOperator,
        gatherer: ViewGatherer,
        unknowns: Unknowns,
        report: Report,
        rows: OpenRows | None = None,
    ) -> None:
        """``rows`` of a possibly rolling shutter."""
        self.grid, self.operator, self.unknowns = grid, operator, unknowns
        self._gatherer, self._report, self._rows = gatherer, report, rows
        self._views: list[View] = []
        self._done = 0.0
        self._min_parallax = MIN_PARALLAX * grid.camera.long_edge

    def _tick(self) -> None:
        """Report progress; called at every frame."""
        self._report(self._done)

    def _gather(self, count: int) -> bool:
        """Gather views; return whether there are more than before."""
        before = len(self._views)
        self._views = self._gatherer.gather(self._views, count, self._tick)
        return len(self._views) > before

    def ask(self) -> Estimate | str:
        """Locate and adjust more and more views until the focal length is known; return the
        estimate, or the reason why there is none."""
        start = self._start()
        if isinstance(start, Degeneracy):
            return start.value
        bundle = GrowingBundle(
            self.grid, self.operator, self._views, start, self.unknowns, self._rows
        )
        said: Estimate | str = NOT_FOLLOWED
        while True:
            for view in self._views[len(bundle) :]:
                self._tick()
                if not bundle.place(view):
                    return said
            # Matches are searched again from their positions after the first adjustment.
            for fine in (self.grid.camera.long_edge <= SMALL_IMAGE, True):
                if not self._adjusted(bundle, fine):
                    return said
            said = estimate(bundle, self.unknowns)
            self._done = 0.3 + 0.7 * min(1.0, len(bundle) / KEYFRAMES)
            if isinstance(said, Estimate) and _is_enough(said):
                return said
            if not self._gather(min(len(bundle) + START_KEYFRAMES, KEYFRAMES)):
                return said

    def _adjusted(self, bundle: GrowingBundle, fine: bool) -> bool:
        """Match and adjust the views; return whether it succeeded."""
        bundle.measure(fine, self._tick)
        return bundle.adjust()

    def _start(self) -> Start | Degeneracy:
        """Return the first views with parallax and depth, located with the best candidate."""
        failure = Degeneracy.BLANK
        while failure is not Degeneracy.UNEXPLAINED and self._gather(START_KEYFRAMES):
            if len(self._views) < MIN_VIEWS:
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
        wrong = degeneracy(camera, flows, self._min_parallax)
        if wrong is not None and (self.unknowns.focal or wrong is not Degeneracy.PLANAR):
            return wrong
        # One after the other: in parallel their many small operations would wait for Python.
        starts = (
            try_candidate(lens, flows, self._min_parallax, self.unknowns)
            for lens in candidates(camera, self.unknowns)
        )
        found = [s for s in starts if s is not None]
        if not found:
            return Degeneracy.TURNING
        best = min(found, key=lambda s: s.penalised)
        # A rolling shutter is not modelled yet.
        is_explained = best.cost <= MAX_COST or self._rows is not None
        return best if is_explained else Degeneracy.UNEXPLAINED


def _is_enough(said: Estimate) -> bool:
    """Whether no more keyframes are needed."""
    readout = said.readout
    return said.deviation < ENOUGH_DEVIATION and (readout is None or readout.error < ENOUGH_ERROR)
