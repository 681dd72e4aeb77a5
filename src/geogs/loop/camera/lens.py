"""Shared intrinsics in the adjustment of all keyframes: k1, k2, focal length, principal point.

Matches are those of images as they came, seen by the given or estimated lens. Its remaining error
is small, and all matches of the video together determine it; a straight walk drifts in scale until
it is corrected.
The grid gets the estimated camera and everything is adjusted again; matches do not change. The
focal length is corrected with it where matches require that: one estimated for a pinhole is off by
several percent (docs/notebook/lens.md).
"""

import math
from dataclasses import replace
from functools import partial

from jaxtyping import Float
from torch import Tensor

from geogs.bundle.uncertainty.lens_error import (
    FOCAL_LEFT,
    RADIAL,
    SHAPES,
    STANDARD_ERRORS,
    LensEstimate,
    LensEvidence,
    lens_prior,
)
from geogs.geometry.camera import Camera
from geogs.loop.keyframe_matches import KeyframeMatches
from geogs.tracking.frames.pose_filling import row_errors, shift_rows
from geogs.tracking.frames.row_errors import RowErrors, row_shifts
from geogs.tracking.keyframe_uncertainty import said_of_lens
from geogs.types import FoundLens
from geogs.world.edges import Pair

ROUNDS = 8
"""Most rounds. Poses and depths follow each to first order: the error left is a fifth to a half of
that of the round before."""
CONVERGED = 0.2
"""Largest change of a parameter in the last round, in standard deviations."""
MOST_AT_ONCE = 0.3
"""Largest step of the logarithm of the focal length in a round, as steps are to first order."""
EVIDENCE, AGREEMENT = 49.0, 0.5
"""Squared Mahalanobis distance from zero above which k1 and k2 beyond a given lens are accepted,
and least agreement between the halves of the video (:meth:`LensEvidence.agreement`). Errors of
matches of different keyframes are correlated and their evidence adds up; but these errors differ
from half to half (docs/notebook/lens.md)."""
FOCAL_EVIDENCE = 6.0
"""Error of a given focal length, in standard errors, above which it is corrected with k1 and k2.
For a correct one it is 0 to 2.6, once 4.0, on which halves of that video agreed
(docs/notebook/lens.md)."""
CENTRE_EVIDENCE = 64.0
"""Squared Mahalanobis distance above which the principal point of a lens that was not given is
moved from the middle. It is below 1 where the middle is right, above 80 where it is off by 3 % of
the height. With 36 the kitchen has it corrected in one run and not in the next
(docs/notebook/lens.md)."""
FOCAL_DOUBT = 0.05
"""Relative deviation of the estimated focal length above which a given one is kept: k1 and k2 then
explain the matches equally well."""
READOUT_DOUBT = 0.05
"""Relative deviation of the readout above which it is estimated, too: the estimate from matches is
itself 2 to 6 % short (docs/notebook/lens.md)."""


def correct_lens(
    matches: KeyframeMatches,
    ends: bool = False,
    before: FoundLens | None = None,
    readout: float = 1.0,
) -> FoundLens | None:
    """Estimate the lens from all matches and adjust again; None, without changes, where there is no
    correction.

    The estimated camera becomes that of the grid. Beyond a given lens k1 and k2 are accepted by
    ``EVIDENCE`` and ``AGREEMENT``. All parameters are estimated, however small, after an estimate
    ``before``, and where tracking ``ends`` and the focal length was estimated or guessed
    (``KeyframeTable.focal_deviation``; the prior is
    :func:`~geogs.bundle.uncertainty.lens_error.lens_prior`); then also the principal point. The
    focal length is only corrected at the end, and so is an estimated readout: rows were corrected
    for ``readout`` times it. Not in the world of a saved map, whose keyframes are fixed.
    """
    if not matches.measured or matches.tracker.segment.fixed:
        return None
    search = _LensSearch(matches, ends, before, readout)
    while search.left and search.step():
        matches.adjust()
    return search.found()


class _LensSearch:
    """Iterative estimation of the lens parameters."""

    def __init__(
        self, matches: KeyframeMatches, ends: bool, before: FoundLens | None, readout: float
    ) -> None:
        self.left = ROUNDS
        """Rounds left."""
        self._matches = matches
        self._table = matches.keyframes.table
        self._ends = ends
        self._before = before
        self._readout = readout
        self._longer = 0.0
        self._said: LensEstimate | None = None
        self._is_open = ends and self._table.focal_deviation > 0
        self._frees_focal = before.focal != 1 if before else self._is_open
        self._frees_centre = self._is_open and (before is None or before.is_off_centre)
        rows = row_errors(matches.log, matches.keyframes) if ends else None
        if rows is not None:
            rows = rows.with_readout(readout) if rows.doubt >= READOUT_DOUBT else None
        self._rows = rows

    def step(self) -> bool:
        """Take a step; False without evidence, or with too little against a given lens."""
        evidence = said_of_lens(self._matches.tracker, list(self._matches.free_depth), self._rows)
        if evidence is None:
            return False
        is_accepted = self._before is not None or self._is_open or self._said is not None
        if not is_accepted and not self._contradicts_given(evidence):
            return False
        self.left -= 1
        self._said = said = self._chosen(evidence)
        if bool((said.size.abs() < CONVERGED * said.deviation).all()):
            self.left = 0
        size = said.size.tolist()
        if self._rows is not None:
            self._longer += size.pop()
            self._matches.corrections["readout"] = partial(self._shifts, self._rows)
        focal = size.pop(0) if self._frees_focal else 0.0
        self._matches.graph.see_by(self._matches.camera.moved(focal, *size))
        if not self.left and self._frees_centre and not self._before:
            self._leave_centre_unless_sure(said)
        return True

    def _contradicts_given(self, evidence: LensEvidence) -> bool:
        """Whether matches require another k1 and k2 of a given lens, and independent halves of the
        video agree on them."""
        if evidence.bend.evidence < EVIDENCE:
            return False
        ids = list(self._matches.free_depth)
        middle = len(ids) // 2
        first = said_of_lens(self._matches.tracker, ids[: middle + 1], self._rows)
        second = said_of_lens(self._matches.tracker, ids[middle:], self._rows)
        return first is not None and second is not None and first.agreement(second) >= AGREEMENT

    @property
    def _moves(self) -> tuple[float, ...]:
        """Changes of the camera relative to the given one."""
        return self._matches.camera.moves_from(self._table.assumed)

    def _chosen(self, evidence: LensEvidence) -> LensEstimate:
        """Return the estimate of the free parameters, with their priors."""
        said = evidence.whole(self._frees_centre)
        shapes = SHAPES if self._frees_centre else RADIAL
        if self._is_open:
            priors = lens_prior(self._table.focal_deviation)[:shapes]
            for n, (taken, prior) in enumerate(zip(self._moves, priors, strict=False)):
                said = said.told(n, -taken, prior)
        if self._rows is not None:
            said = said.told(shapes, 1 - self._readout - self._longer, self._rows.doubt)
        if self._ends and not self._frees_focal and _contradict_focal(said):
            self._frees_focal = True
            self.left = ROUNDS
        if self._frees_focal:
            return said.shortened(0, MOST_AT_ONCE)
        return evidence.bend if self._rows is None and not self._frees_centre else said.without(0)

    def _leave_centre_unless_sure(self, said: LensEstimate) -> None:
        """Restart with the principal point in the middle, unless it is significantly elsewhere."""
        found = said.size.new_tensor(self._moves[RADIAL:])
        if said.of(slice(RADIAL, SHAPES))._replace(size=found).evidence < CENTRE_EVIDENCE:
            self._frees_centre = False
            self.left = ROUNDS
            given = self._table.assumed
            self._matches.graph.see_by(replace(self._matches.camera, cx=given.cx, cy=given.cy))

    def _shifts(self, rows: RowErrors, part: list[Pair]) -> Float[Tensor, "e p 2"]:
        """Return the shifts of the matches of some edges, in pixels, for the present readout."""
        matches = self._matches
        return self._longer * row_shifts(rows, matches.keyframes, part, matches.measured).slope

    def found(self) -> FoundLens | None:
        """Return the lens with its deviations; None if nothing was estimated."""
        if self._said is None:
            return None
        log = self._matches.log
        focal = self._moves[0]
        deviation = self._said.deviation.tolist()
        if self._rows is not None:
            readout = self._readout + self._longer
            shift_rows(log, self._matches.keyframes, self._rows.with_readout(readout))
            log.set_readout(readout, deviation.pop())
        # Errors of different keyframes are correlated, as before the run (docs/notebook/lens.md).
        deviation = [STANDARD_ERRORS * error for error in deviation]
        open_focal = math.hypot(deviation.pop(0), FOCAL_LEFT * focal) if self._frees_focal else 0.0
        k1, k2, *of_centre = deviation
        said = FoundLens(
            0.0, 0.0, k1, k2, 1.0, open_focal, deviation_centre=max(of_centre, default=0.0)
        )
        return found_lens(self._table.assumed, self._matches.camera, said)


def _contradict_focal(said: LensEstimate) -> bool:
    """Whether a given focal length is wrong by much more than its deviation."""
    size = abs(float(said.size[0]))
    deviation = float(said.deviation[0])
    return size > FOCAL_EVIDENCE * deviation and STANDARD_ERRORS * deviation < FOCAL_DOUBT


def found_lens(given: Camera, found: Camera, said: FoundLens | None = None) -> FoundLens:
    """Return the lens of an estimated camera relative to the ``given`` one; deviations are those in
    ``said``."""
    focal, k1, k2, right, down = found.moves_from(given)
    said = said or FoundLens()
    return replace(said, k1=k1, k2=k2, focal=math.exp(focal), right=right, down=down)
