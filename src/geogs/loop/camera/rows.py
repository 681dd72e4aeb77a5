"""Rows of a rolling shutter in the global adjustment, by its trajectory.

The matches are those of images whose rows were rectified before anything was known of the scene.
The remaining errors follow from the adjusted trajectory and depths (``frames/row_errors.py`` of
tracking); matches are corrected for them, and everything is adjusted again. Flow is not measured
again. A readout estimated from the video, which may be off by some percent, is estimated again on
the way: at the right one the derivative of the cost of all matches is zero.
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
"""Rounds without estimating the readout: the first removes most of the errors."""
READOUTS = 3
"""Most readouts tried after the first round."""
SETTLED = 0.003
"""Relative change of the readout below which the search ends."""
BETWEEN = 4
"""Steps of all adjustments but the last, which continues from them."""
MOVES = 0.6
"""Fraction of a lens's motion that rows have to show for it to move during readout."""
FIRST_STEP, FARTHEST = 0.04, 0.25
"""First relative step of the readout, and its largest relative change."""


def correct_rows(matches: KeyframeMatches, finds_readout: bool = True) -> float:
    """Correct all matches for row errors and adjust again; nothing where no rows were rectified.

    Matches of the frames between the keyframes are corrected, too. With ``finds_readout``, a
    readout estimated from the video is estimated again. Returns its ratio to the former readout.
    """
    keyframes = matches.keyframes
    log = matches.log
    search = _Search()
    last = ROUNDS - 1
    matches.corrections.pop("readout", None)  # now included in the rows
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
    """Return the shifts that correct the matches of some edges for row errors."""
    return row_shifts(errors, keyframes, part, measured).shift


def let_lenses_move(matches: KeyframeMatches, lenses: Mapping[int, FrameLens]) -> None:
    """Let the principal points of frames move during readout, if the matches support it.

    A stabilised lens moves all the time, while a crop is moved after an image was read. Matches are
    corrected for these lenses.
    """
    keyframes = matches.keyframes
    log = matches.log
    still = row_errors(log, keyframes) if lenses else None
    if still is None:
        return
    moving = still.with_lenses(lenses)
    if part_seen(still, moving, keyframes, matches.corrected(but="rows"), log) > MOVES:
        log.lenses = dict(lenses)


class _Search:
    """Search for the zero of a cost's gradient by secants, near the prior readout."""

    def __init__(self) -> None:
        self.factor = 1.0
        self._last: tuple[float, float] | None = None

    def step(self, gradient: float) -> None:
        """Update the factor, given the gradient of the cost at the present one."""
        here = self.factor
        if self._last is None:
            self.factor -= FIRST_STEP if gradient > 0 else -FIRST_STEP
        else:
            before, there = self._last
            slope = (gradient - there) / (here - before) if here != before else 0.0
            # Without a minimum go back to the prior.
            self.factor = here - gradient / slope if slope > 0 else 1.0
        self.factor = min(max(self.factor, 1 - FARTHEST), 1 + FARTHEST)
        self._last = here, gradient


def _readout_gradient(
    matches: KeyframeMatches, measured: Measured, errors: RowErrors, factor: float
) -> float:
    """Return half the derivative of the cost, including the prior, by the factor on the readout, at
    that of ``errors``."""
    total = (factor - 1) / errors.doubt**2
    keyframes = matches.keyframes
    huber = matches.options.huber
    grid = keyframes.grid
    for part, (shift, slope) in edge_shifts(errors, keyframes, measured):
        T = keyframes.relative_poses(part)
        depth = keyframes.inverse_depths([i for i, _ in part])
        pixels, weight = edge_matches(grid, [measured[pair] for pair in part])
        weight = static_weight(keyframes, part, pixels, weight)
        p = project(grid.camera, grid.rays, T, depth)
        residual, weight = weighed_residuals(p, pixels + shift, weight, huber)
        total += EVIDENCE * float((weight * residual * slope).double().sum())
    return total
