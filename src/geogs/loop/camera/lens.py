"""Shared intrinsics in the adjustment of all keyframes: k1, k2, focal length, principal point.

Images were undistorted by the given or found lens. The distortion that remains is small, and all
matches of the video together determine it; a walk straight on drifts in scale until it is
corrected. Matches are corrected and everything is adjusted again; flow stays as it is. The focal
length is corrected with it where matches require that: one that was found for a pinhole is off by
several percent (docs/notebook/lens.md).
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
"""Standard deviations by which the last round may change a parameter."""
MOST_AT_ONCE = 0.3
"""Largest step of the logarithm of the focal length in a round, as steps are to first order."""
EVIDENCE, AGREEMENT = 49.0, 0.5
"""Squared Mahalanobis distance from zero at which k1 and k2 beside a given lens are accepted, if
they agree so far between the halves of the video (:meth:`LensEvidence.agreement`). Matches of
different keyframes err alike and their evidence adds up: only what they err in differs from half to
half (docs/notebook/lens.md)."""
FOCAL_EVIDENCE = 6.0
"""Standard errors at which a given focal length is corrected beside k1 and k2. Of a right one it is
0 to 2.6, once 4.0, which halves of that video agreed on (docs/notebook/lens.md)."""
CENTRE_EVIDENCE = 64.0
"""Squared Mahalanobis distance at which the principal point of a lens that is not given is taken
off the middle. It is below 1 where it is there, above 80 where it is 3 % of the height off. With 36
the kitchen has it corrected in one run and not in the next (docs/notebook/lens.md)."""
FOCAL_DOUBT = 0.05
"""Relative deviation of the focal length from which on a given one is kept: k1 and k2 explain as
well what matches know that badly."""
READOUT_DOUBT = 0.05
"""Relative deviation of the readout from which on it is estimated, too: by matches it comes out
2 to 6 % short itself (docs/notebook/lens.md)."""


def correct_lens(
    matches: KeyframeMatches,
    ends: bool = False,
    before: FoundLens | None = None,
    readout: float = 1.0,
) -> FoundLenses:
    """Estimate the lens from all matches, correct them for it and adjust again.

    Matches of the frames between the keyframes are corrected, too. Beside a given lens k1 and k2
    are accepted by ``EVIDENCE`` and ``AGREEMENT``. All is estimated, however small, where images
    are straight by ``before``, and where tracking ``ends`` and the focal length was found or
    guessed (``KeyframeTable.focal_deviation``; the prior is
    :func:`~geogs.bundle.uncertainty.lens_error.lens_prior`); then the principal point is, too. The
    focal length is corrected at the end alone, as what is matched afterwards would be of another;
    so is a readout that was found: rows were corrected for ``readout`` times it. Not in the world
    of a saved map, whose keyframes stay as they are.
    """
    measured = matches.graph.packed
    if not measured or matches.tracker.segment.fixed:
        return FoundLenses()
    search = _LensSearch(matches, ends, before, readout)
    while search.left and search.step():
        matches.correct(measured, lambda part: search.shifts(part, measured))
    return search.found()


class _LensSearch:
    """Parameters of the lens' error, from round to round."""

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
        self._frees_focal = before.focal != 1 if before else self._is_open
        self._frees_centre = self._is_open and (before is None or before.is_off_centre)
        self._rows = _rows_in_doubt(matches, readout) if ends else None

    def step(self) -> bool:
        """Take a step; false without evidence, or where it is not enough for a given lens."""
        evidence = said_of_lens(self._matches.tracker, list(self._matches.free_depth), self._rows)
        if evidence is None:
            return False
        is_accepted = self._before is not None or self._is_open or self._said is not None
        if not is_accepted and not self._contradicts_given(evidence):
            return False
        self.left -= 1
        self._said = said = self._chosen(evidence)
        if self._frees_focal:
            self._focal += float(said.size[0])
            if self._before:  # cells stay where straight images show them
                self._bend = replace(self._bend, focal=self._focal)
            else:
                self._matches.graph.refocus(math.exp(self._focal))
        if self._rows is not None:
            self._longer += float(said.size[-1])
        if bool((said.size.abs() < CONVERGED * said.deviation).all()):
            self.left = 0
        first = int(self._frees_focal)
        self._bend = self._bend.plus(*said.size[first : first + self._shapes - 1].tolist())
        if not self.left and self._frees_centre and not self._before:
            self._leave_centre_unless_sure(said)
        return True

    def _contradicts_given(self, evidence: LensEvidence) -> bool:
        """Whether matches say, and independent halves of the video agree, that a given lens has
        another k1 and k2."""
        if evidence.bend.evidence < EVIDENCE:
            return False
        halves = self._halves()
        return len(halves) == 2 and halves[0].agreement(halves[1]) >= AGREEMENT

    def _halves(self) -> list[LensEvidence]:
        """Evidence of the keyframes of either half of the video by itself, where there is any."""
        ids = list(self._matches.free_depth)
        halves = ids[: len(ids) // 2 + 1], ids[len(ids) // 2 :]
        found = (said_of_lens(self._matches.tracker, half, self._rows) for half in halves)
        return [evidence for evidence in found if evidence is not None]

    @property
    def _shapes(self) -> int:
        return SHAPES if self._frees_centre else RADIAL

    def _chosen(self, evidence: LensEvidence) -> LensEstimate:
        """The estimate of the free parameters, with their priors."""
        said = evidence.whole(self._frees_centre)
        if self._is_open:
            bend = self._bend
            taken = self._focal, bend.k1, bend.k2, bend.right, bend.down
            priors = lens_prior(self._keyframes.table.focal_deviation)[: self._shapes]
            for n, prior in enumerate(priors):
                said = said.told(n, -taken[n], prior)
        if self._rows is not None:
            said = said.told(self._shapes, 1 - self._readout - self._longer, self._rows.doubt)
        if self._ends and not self._frees_focal and _contradict_focal(said):
            self._frees_focal, self.left = True, ROUNDS
        if self._frees_focal:
            return said.shortened(0, MOST_AT_ONCE)
        return evidence.bend if self._rows is None and not self._frees_centre else said.without(0)

    def _leave_centre_unless_sure(self, said: LensEstimate) -> None:
        """Begin again with the principal point in the middle, unless it is clearly elsewhere."""
        found = said.size.new_tensor([self._bend.right, self._bend.down])
        if said.of(slice(RADIAL, SHAPES))._replace(size=found).evidence < CENTRE_EVIDENCE:
            self._frees_centre, self.left = False, ROUNDS
            self._bend = replace(self._bend, right=0.0, down=0.0)

    def shifts(self, part: list[Pair], measured: Measured) -> Float[Tensor, "e p 2"]:
        """Pixels to be added to the matches of some edges, as if a pinhole had seen them, with the
        readout as it is known now."""
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
        # Matches of different keyframes err alike, here as before the run (docs/notebook/lens.md).
        deviation = [STANDARD_ERRORS * error for error in deviation]
        open_focal = math.hypot(deviation.pop(0), FOCAL_LEFT * focal) if self._frees_focal else 0.0
        k1, k2, *of_centre = deviation
        lens = FoundLens(
            bend.k1, bend.k2, k1, k2, math.exp(focal), open_focal, bend.right, bend.down,
            max(of_centre, default=0.0),
        )  # fmt: skip
        return FoundLenses(lens)


def _contradict_focal(said: LensEstimate) -> bool:
    """Whether a given focal length is wrong by much more than its deviation."""
    size, deviation = abs(float(said.size[0])), float(said.deviation[0])
    return size > FOCAL_EVIDENCE * deviation and STANDARD_ERRORS * deviation < FOCAL_DOUBT


def _rows_in_doubt(matches: KeyframeMatches, readout: float) -> RowErrors | None:
    """Rows that were rectified by a readout of large deviation, where there are any."""
    rows = row_errors(matches.log, matches.keyframes)
    return None if rows is None or rows.doubt < READOUT_DOUBT else rows.with_readout(readout)
