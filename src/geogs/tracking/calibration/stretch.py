"""One stretch of a video whose views are placed and adjusted together with the lens."""

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
"""Keyframes of a stretch that are solved first, and by which it then grows."""
KEYFRAMES = 24
"""Most keyframes of a stretch; they are added until the focal length is known well enough."""
ENOUGH_DEVIATION, ENOUGH_ERROR = 0.01, 0.003
"""Relative deviation of the focal length, and seconds of the readout's, from which no more
keyframes of a stretch are used: all matches of the run are asked again at its end
(docs/notebook/lens.md)."""
SMALL_IMAGE = 400
"""Pixels of the long edge of images that are matched at full resolution from the start, larger ones
at half of it first."""
MIN_PARALLAX = 0.003
"""Motion that rotation does not explain, needed between two keyframes, of the long edge: some
deviations of a match, from which on views can be placed. Whether they tell the focal length their
adjustment says (docs/notebook/calibration.md)."""
MIN_VIEWS = 4
NOT_FOLLOWED = "its motion could not be followed"

Report = Callable[[float], None]


class Stretch:
    """Views that follow each other, from where the gatherer is."""

    def __init__(
        self,
        grid: SampleGrid,
        operator: FlowOperator,
        gatherer: ViewGatherer,
        unknowns: Unknowns,
        report: Report,
        rows: OpenRows | None = None,
    ) -> None:
        """``rows`` of a shutter that may roll."""
        self.grid, self.operator, self.unknowns = grid, operator, unknowns
        self._gatherer, self._report, self._rows = gatherer, report, rows
        self._views: list[View] = []
        self._done = 0.0
        self._min_parallax = MIN_PARALLAX * grid.camera.long_edge

    def _tick(self) -> None:
        """Every frame is a safe point."""
        self._report(self._done)

    def _gather(self, count: int) -> bool:
        """Whether there are more views than before."""
        before = len(self._views)
        self._views = self._gatherer.gather(self._views, count, self._tick)
        return len(self._views) > before

    def ask(self) -> Estimate | str:
        """Place and adjust views, more of them until the focal length is known; what they say of
        it, or why they say nothing."""
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
            # Matches are searched again from where the first adjustment has them.
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
        """Whether views were matched and adjusted."""
        bundle.measure(fine, self._tick)
        return bundle.adjust()

    def _start(self) -> Start | Degeneracy:
        """The first views that show parallax and depth, placed by the best candidate."""
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
            # What comes later may show more.
            self._views = self._views[len(self._views) // 2 :]
        return failure

    def _solve_start(self, flows: list[FlowMatch]) -> Start | Degeneracy:
        camera = self.grid.camera
        wrong = degeneracy(camera, flows, self._min_parallax)
        if wrong is not None and (self.unknowns.focal or wrong is not Degeneracy.PLANAR):
            return wrong
        # One after the other: beside each other their many small operations wait for Python.
        starts = (
            try_candidate(lens, flows, self._min_parallax, self.unknowns)
            for lens in candidates(camera, self.unknowns)
        )
        found = [s for s in starts if s is not None]
        if not found:
            return Degeneracy.TURNING
        best = min(found, key=lambda s: s.penalised)
        # Rows that roll are not explained yet.
        is_explained = best.cost <= MAX_COST or self._rows is not None
        return best if is_explained else Degeneracy.UNEXPLAINED


def _is_enough(said: Estimate) -> bool:
    """Whether more keyframes need not be asked."""
    readout = said.readout
    return said.deviation < ENOUGH_DEVIATION and (readout is None or readout.error < ENOUGH_ERROR)
