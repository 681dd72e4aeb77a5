"""The lens in the adjustment of all keyframes, where the matches say that it bends otherwise.

Images were undistorted by what was said of the lens, which may be nothing. What is left is a small
k1 and k2 that all matches of the video tell together. They are taken off the matches, and
everything is adjusted again; flow stays as it is. Until then a walk straight on drifts in scale.
The focal length is corrected with them where they ask for that, too: one that was found while the
lens was taken for a pinhole is off by several percent (docs/lens.md).
"""

import math
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from geogs.bundle.uncertainty.lens_error import (
    FOCAL_LEFT,
    RADIAL,
    SHAPES,
    STANDARD_ERRORS,
    LensBend,
    LensEstimate,
    LensEvidence,
    lens_prior,
)
from geogs.loop.camera.found import FoundLenses
from geogs.loop.keyframe_matches import KeyframeMatches, Measured
from geogs.tracking.frames.pose_filling import row_errors, shift_lens, shift_rows
from geogs.tracking.frames.row_errors import RowErrors, row_shifts
from geogs.tracking.keyframe_uncertainty import said_of_lens
from geogs.types import FoundLens
from geogs.world.edges import Pair

ROUNDS = 8
"""At most. Each is to first order and leaves a fifth to a half of what the one before it left."""
CONVERGED = 0.2
"""Deviations by which the last round may have changed a size."""
MOST_AT_ONCE = 0.3
"""By which the logarithm of the focal length changes in a round, at most: to first order is no more
than a guess farther away."""
EVIDENCE = 81.0
"""Square of the sizes in their deviations from which on they are believed. Matches of different
keyframes err alike, too: where the lens was known it is 1 to 10, where it was not, hundreds
(docs/lens.md)."""
FOCAL_EVIDENCE = 4.0
"""Deviations from which on the focal length is believed to be off, too, where k1 and k2 are. Where
it was given it is 0 to 2.2 (docs/lens.md)."""
CENTRE_EVIDENCE = 64.0
"""Square of the principal point in its deviations from which on it is believed to be off, where
nobody told of the lens. Where rendered rooms have it in the middle it came out within a deviation
of that, where it lies 3 % of the height off it, nine and more away. With six the kitchen,
whose point is near the middle, has it corrected in one run and not in the next (docs/lens.md)."""
FOCAL_DOUBT = 0.05
"""Deviation of the focal length, as a part of it, from which on matches do not overrule one that
was given: what they know that badly k1 and k2 explain as well."""
READOUT_DOUBT = 0.05
"""Part of the readout that its deviation has to be for matches to be asked for it, too: what they
say of it comes out 2 to 6 % short itself (docs/lens.md)."""


def correct_lens(
    matches: KeyframeMatches,
    ends: bool = False,
    before: FoundLens | None = None,
    readout: float = 1.0,
) -> FoundLenses:
    """Correct all matches for the lens and adjust again; nothing where they do not ask for it.

    What was measured of the frames between the keyframes is corrected, too. The focal length is
    only where tracking ``ends`` with it: what is matched afterwards would be of another; so is the
    readout, where it was found in the video: matches were corrected for rows that took so many
    times it. ``before`` was found already, and images are straight, so that what matches say is
    believed however little it is; so is it at the end, and the focal length with it, where that was
    but found in the video or guessed (``KeyframeTable.focal_deviation``): the sizes are expected to
    be about what the images were taken for then
    (:func:`~geogs.bundle.uncertainty.lens_error.lens_prior`), and the principal point is corrected
    as well where the matches are sure of it. Not in the world of a saved map, whose keyframes stay
    as its own adjustment left them.
    """
    measured = matches.graph.packed
    if not measured or matches.tracker.segment.fixed:
        return FoundLenses()
    search = _LensSearch(matches, ends, before, readout)
    while search.left and search.step():
        matches.correct(measured, lambda part: search.shifts(part, measured))
    return search.found()


class _LensSearch:
    """Sizes of the lens' error on the way to where matches ask for no more."""

    def __init__(
        self, matches: KeyframeMatches, ends: bool, before: FoundLens | None, readout: float
    ) -> None:
        self.left = ROUNDS
        """Rounds that may follow."""
        self._matches, self._keyframes, self._ends = matches, matches.keyframes, ends
        self._before, self._readout = before, readout
        self._bend, self._focal, self._longer = LensBend(), 0.0, 0.0
        self._said: LensEstimate | None = None
        self._is_open = ends and matches.keyframes.table.focal_deviation > 0
        self._asks_focal = before.focal != 1 if before else self._is_open
        self._asks_centre = self._is_open and (before is None or before.is_off_centre)
        self._rows = _rows_in_doubt(matches, readout) if ends else None

    def step(self) -> bool:
        """Go on to what matches say now; false where they say nothing, or are not believed."""
        evidence = said_of_lens(self._matches.tracker, list(self._matches.free_depth), self._rows)
        if evidence is None:
            return False
        asks = self._before is not None or self._is_open or self._said is not None
        if not asks and evidence.bend.evidence < EVIDENCE:
            return False
        self.left -= 1
        self._said = said = self._chosen(evidence)
        if self._asks_focal:
            self._focal += float(said.size[0])
            if self._before:  # cells stay where straight images show them
                self._bend = replace(self._bend, focal=self._focal)
            else:
                self._matches.graph.refocus(math.exp(self._focal))
        if self._rows is not None:
            self._longer += float(said.size[-1])
        if bool((said.size.abs() < CONVERGED * said.deviation).all()):
            self.left = 0
        first = int(self._asks_focal)
        self._bend = self._bend.plus(*said.size[first : first + self._shapes - 1].tolist())
        if not self.left and self._asks_centre and not self._before:
            self._leave_centre_unless_sure(said)
        return True

    @property
    def _shapes(self) -> int:
        return SHAPES if self._asks_centre else RADIAL

    def _chosen(self, evidence: LensEvidence) -> LensEstimate:
        """The estimate of what is asked for, with what was known of it before."""
        said = evidence.whole(self._asks_centre)
        if self._is_open:
            bend = self._bend
            taken = self._focal, bend.k1, bend.k2, bend.right, bend.down
            priors = lens_prior(self._keyframes.table.focal_deviation)[: self._shapes]
            for n, prior in enumerate(priors):
                said = said.told(n, -taken[n], prior)
        if self._rows is not None:
            said = said.told(self._shapes, 1 - self._readout - self._longer, self._rows.doubt)
        if self._ends and not self._asks_focal and _contradict_focal(said):
            self._asks_focal, self.left = True, ROUNDS
        if self._asks_focal:
            return said.shortened(0, MOST_AT_ONCE)
        return evidence.bend if self._rows is None and not self._asks_centre else said.without(0)

    def _leave_centre_unless_sure(self, said: LensEstimate) -> None:
        """Begin again with the principal point in the middle, unless matches are sure of it."""
        found = said.size.new_tensor([self._bend.right, self._bend.down])
        if said.of(slice(RADIAL, SHAPES))._replace(size=found).evidence < CENTRE_EVIDENCE:
            self._asks_centre, self.left = False, ROUNDS
            self._bend = replace(self._bend, right=0.0, down=0.0)

    def shifts(self, part: list[Pair], measured: Measured) -> Float[Tensor, "e p 2"]:
        """What brings the matches of some edges to where a pinhole would have them, whose rows were
        seen over a readout that is longer by a part of it."""
        grid, keyframes = self._keyframes.grid, self._keyframes
        T_ji, depth = keyframes.relative_poses(part), keyframes.inverse_depths([i for i, _ in part])
        shifts = self._bend.of_matches(grid.camera, grid.rays, T_ji, depth)
        if self._rows is None or self._longer == 0:
            return shifts
        return shifts + self._longer * row_shifts(self._rows, keyframes, part, measured).slope

    def found(self) -> FoundLenses:
        """The lens, by which the frames between the keyframes are corrected, too."""
        if self._said is None:
            return FoundLenses()
        log, bend, focal = self._matches.log, self._bend, self._focal
        deviation = self._said.deviation.tolist()
        if self._rows is not None:
            readout = self._readout + self._longer
            shift_rows(log, self._keyframes, self._rows.with_readout(readout))
            log.set_readout(readout, deviation.pop())
        shift_lens(log, self._keyframes, bend)
        # Matches of different keyframes err alike too (docs/lens.md), here as before the run.
        deviation = [STANDARD_ERRORS * error for error in deviation]
        open_focal = math.hypot(deviation.pop(0), FOCAL_LEFT * focal) if self._asks_focal else 0.0
        k1, k2, *of_centre = deviation
        lens = FoundLens(
            bend.k1, bend.k2, k1, k2, math.exp(focal), open_focal, bend.right, bend.down,
            max(of_centre, default=0.0),
        )  # fmt: skip
        return FoundLenses(lens)


def _contradict_focal(said: LensEstimate) -> bool:
    """Whether matches say for sure that the focal length is another than was given."""
    size, deviation = abs(float(said.size[0])), float(said.deviation[0])
    return size > FOCAL_EVIDENCE * deviation and STANDARD_ERRORS * deviation < FOCAL_DOUBT


def _rows_in_doubt(matches: KeyframeMatches, readout: float) -> RowErrors | None:
    """Those that were rectified by a readout that the video told badly, where there are any."""
    rows = row_errors(matches.log, matches.keyframes)
    return None if rows is None or rows.doubt < READOUT_DOUBT else rows.with_readout(readout)
