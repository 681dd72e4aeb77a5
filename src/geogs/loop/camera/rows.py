"""Rows of a rolling shutter in the adjustment of all keyframes, by the trajectory that it gives.

The matches are those of images whose rows were rectified before anything was known of the scene.
What is left follows from the adjusted trajectory and depths (``frames/row_errors.py`` of tracking),
taken off the matches, and everything is adjusted again. Flow is not measured anew. A readout that
was found in the video, and may be off by some percent, is found once more on the way: it is right
where all matches together would become neither better nor worse with another.
"""

from collections.abc import Mapping
from functools import partial

from jaxtyping import Float
from torch import Tensor

from geogs.bundle.flow_term import weighed_residuals
from geogs.bundle.projection import project
from geogs.loop.keyframe_matches import KeyframeMatches, Measured
from geogs.tracking.frames.pose_filling import row_errors, shift_rows
from geogs.tracking.frames.row_errors import RowErrors, edge_shifts, row_shifts
from geogs.tracking.graph.dynamic_cells import static_weight
from geogs.tracking.row_twists import EVIDENCE, part_seen, row_twists
from geogs.types import FrameLens
from geogs.world.edges import Pair, edge_matches
from geogs.world.keyframes import KeyframeSet

ROUNDS = 2
"""Where the readout is not searched for: the first takes most of it."""
READOUTS = 3
"""Tried after the first round, at most."""
SETTLED = 0.003
"""Fraction of the readout by less than which a change ends the search."""
BETWEEN = 4
"""Steps of an adjustment that another follows, which goes on from there."""
MOVES = 0.6
"""Part of a lens's motion that rows have to show for it to move while they are read."""
FIRST_STEP, FARTHEST = 0.04, 0.25
"""Fraction of the readout that is tried first, and by which it changes at most."""


def correct_rows(matches: KeyframeMatches, finds_readout: bool = True) -> float:
    """Correct all matches for their rows and adjust again; nothing where no rows were rectified.

    What was measured of the frames between the keyframes is corrected, too. ``finds_readout`` says
    whether the readout is found once more, where it was found in the video. Returns how many times
    the readout it is.
    """
    keyframes, log, search, last = matches.keyframes, matches.log, _Search(), ROUNDS - 1
    matches.corrections.pop("readout", None)  # which the rows have by now
    measured = matches.corrected(but="rows")
    for n in range(1 + READOUTS):
        errors = row_errors(log, keyframes) if measured else None
        if errors is None:
            break
        searches = finds_readout and errors.doubt > 0
        if searches:
            last = READOUTS
        if searches and n > 0:
            before = search.factor
            search.step(_readout_gradient(matches, measured, errors.with_readout(before), before))
            if abs(search.factor - before) < SETTLED:
                last = n
        present = errors.with_readout(search.factor)
        found = row_twists(present, keyframes, measured, log)
        present = present.with_twists(found.frames, found.twist)
        matches.corrections["rows"] = partial(_shifts, present, keyframes, measured)
        matches.adjust(None if n == last else BETWEEN)
        shift_rows(log, keyframes, present)
        if n == last:
            break
    return search.factor


def _shifts(
    errors: RowErrors, keyframes: KeyframeSet, measured: Measured, part: list[Pair]
) -> Float[Tensor, "e p 2"]:
    """What brings the matches of some edges to where they would be if all rows were right."""
    return row_shifts(errors, keyframes, part, measured).shift


def let_lenses_move(matches: KeyframeMatches, lenses: Mapping[int, FrameLens]) -> None:
    """Let the principal points of frames' lenses move while rows are read, if the matches say so.

    A stabilised lens moves all the time, a crop is put elsewhere after an image was read. Matches
    are corrected for these lenses.
    """
    keyframes, log = matches.keyframes, matches.log
    still = row_errors(log, keyframes) if lenses else None
    if still is None:
        return
    moving = still.with_lenses(lenses)
    if part_seen(still, moving, keyframes, matches.corrected(but="rows"), log) > MOVES:
        log.lenses = dict(lenses)


class _Search:
    """Where the gradient of a cost is zero, by secants, kept near what was known before."""

    def __init__(self) -> None:
        self.factor = 1.0
        self._last: tuple[float, float] | None = None

    def step(self, gradient: float) -> None:
        """Go on from the gradient at the present factor, which falls from it on."""
        here = self.factor
        if self._last is None:
            self.factor -= FIRST_STEP if gradient > 0 else -FIRST_STEP
        else:
            before, there = self._last
            slope = (gradient - there) / (here - before) if here != before else 0.0
            # No minimum lies there.
            self.factor = here - gradient / slope if slope > 0 else 1.0
        self.factor = min(max(self.factor, 1 - FARTHEST), 1 + FARTHEST)
        self._last = here, gradient


def _readout_gradient(
    matches: KeyframeMatches, measured: Measured, errors: RowErrors, factor: float
) -> float:
    """Half the derivative of the cost by the factor on the readout, at that of ``errors``, and of
    what was known of it."""
    total = (factor - 1) / errors.doubt**2
    keyframes, huber = matches.keyframes, matches.options.huber
    grid = keyframes.grid
    for part, (shift, slope) in edge_shifts(errors, keyframes, measured):
        T, depth = keyframes.relative_poses(part), keyframes.inverse_depths([i for i, _ in part])
        pixels, weight = edge_matches(grid, [measured[pair] for pair in part])
        weight = static_weight(keyframes, part, pixels, weight)
        p = project(grid.camera, grid.rays, T, depth)
        residual, weight = weighed_residuals(p, pixels + shift, weight, huber)
        total += EVIDENCE * float((weight * residual * slope).double().sum())
    return total
