"""The lens in the adjustment of all keyframes, where the matches say that it bends otherwise.

Images were undistorted by what was said of the lens, which may be nothing. What is left is a small
k1 and k2 that all matches of the video tell together. They are taken off the matches, and
everything is adjusted again; flow stays as it is. Until then a walk straight on drifts in scale.
The focal length is corrected with them where they ask for that, too: one that was found while the
lens was taken for a pinhole is off by several percent (docs/lens.md).
"""

import math
from collections.abc import Sequence
from dataclasses import replace

from geogs.bundle.protocols import BundleOptions
from geogs.bundle.uncertainty.lens_error import (
    FOCAL_LEFT,
    RADIAL,
    SHAPES,
    STANDARD_ERRORS,
    LensBend,
    LensEstimate,
    lens_prior,
)
from geogs.tracking.frames.pose_filling import row_errors, shift_lens, shift_rows
from geogs.tracking.frames.row_errors import RowErrors, in_parts
from geogs.tracking.graph.frame_graph import FrameGraph
from geogs.tracking.keyframe_uncertainty import said_of_lens
from geogs.tracking.tracker import Tracker
from geogs.types import FoundLens
from geogs.world.edges import PackedEdge, Pair, edge_matches
from geogs.world.frames import FrameLog
from geogs.world.keyframes import KeyframeSet

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
    tracker: Tracker,
    free_pose: Sequence[int],
    free_depth: Sequence[int],
    options: BundleOptions,
    ends: bool = False,
    before: FoundLens | None = None,
    readout: float = 1.0,
) -> FoundLens | None:
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
    graph, keyframes, log = tracker.map.graph, tracker.keyframes, tracker.map.recorder.log
    measured = graph.packed
    bend, said, focal, longer = LensBend(), None, 0.0, 0.0
    left = ROUNDS if measured and not tracker.segment.fixed else 0
    focal_deviation = keyframes.table.focal_deviation
    is_open = ends and focal_deviation > 0
    is_asked = before.focal != 1 if before else is_open
    asks_centre = is_open and (before is None or before.is_off_centre)
    rows = _rows_in_doubt(log, keyframes, readout) if ends and left else None
    while left:
        asked = said_of_lens(tracker, list(free_depth), rows)
        if asked is None:
            break
        if said is None and not (before or is_open) and asked.bend.evidence < EVIDENCE:
            break
        said, left = asked.whole(asks_centre), left - 1
        shapes = SHAPES if asks_centre else RADIAL
        if is_open:
            taken = focal, bend.k1, bend.k2, bend.right, bend.down
            for n, prior in enumerate(lens_prior(focal_deviation)[:shapes]):
                said = said.told(n, -taken[n], prior)
        if rows is not None:
            said = said.told(shapes, 1 - readout - longer, rows.doubt)
        if ends and not is_asked and _contradict_focal(said):
            is_asked, left = True, ROUNDS
        if is_asked:
            said = said.shortened(0, MOST_AT_ONCE)
            focal += float(said.size[0])
            if before:  # cells stay where straight images show them
                bend = replace(bend, focal=focal)
            else:
                graph.refocus(math.exp(focal))
        else:
            said = asked.bend if rows is None and not asks_centre else said.without(0)
        if rows is not None:
            longer += float(said.size[-1])
        if bool((said.size.abs() < CONVERGED * said.deviation).all()):
            left = 0
        first = int(is_asked)
        bend = bend.plus(*said.size[first : first + shapes - 1].tolist())
        if not left and asks_centre and not before:
            found = said.size.new_tensor([bend.right, bend.down])
            if said.of(slice(RADIAL, SHAPES))._replace(size=found).evidence < CENTRE_EVIDENCE:
                asks_centre, left, bend = False, ROUNDS, replace(bend, right=0.0, down=0.0)
        _shift(graph, measured, bend, rows, longer)
        graph.adjust(list(graph.edges), free_pose, free_depth, options)
    if said is None:
        return None
    deviation = said.deviation.tolist()
    if rows is not None:
        shift_rows(log, keyframes, rows.with_readout(readout + longer))
        log.set_readout(readout + longer, deviation.pop())
    shift_lens(log, keyframes, bend)
    # Matches of different keyframes err alike too (docs/lens.md), here as before the run.
    deviation = [STANDARD_ERRORS * error for error in deviation]
    open_focal = math.hypot(deviation.pop(0), FOCAL_LEFT * focal) if is_asked else 0.0
    k1, k2, *of_centre = deviation
    return FoundLens(
        bend.k1, bend.k2, k1, k2, math.exp(focal), open_focal, bend.right, bend.down,
        max(of_centre, default=0.0),
    )  # fmt: skip


def _contradict_focal(said: LensEstimate) -> bool:
    """Whether matches say for sure that the focal length is another than was given."""
    size, deviation = abs(float(said.size[0])), float(said.deviation[0])
    return size > FOCAL_EVIDENCE * deviation and STANDARD_ERRORS * deviation < FOCAL_DOUBT


def _rows_in_doubt(log: FrameLog, keyframes: KeyframeSet, readout: float) -> RowErrors | None:
    """Those that were rectified by a readout that the video told badly, where there are any."""
    rows = row_errors(log, keyframes)
    return None if rows is None or rows.doubt < READOUT_DOUBT else rows.with_readout(readout)


def _shift(
    graph: FrameGraph,
    measured: dict[Pair, PackedEdge],
    bend: LensBend,
    rows: RowErrors | None,
    longer: float,
) -> None:
    """Have the measured edges with their matches where a pinhole would have them, whose rows were
    seen over a readout that is longer by a part of it."""
    grid, keyframes = graph.keyframes.grid, graph.keyframes
    for part in in_parts(sorted(measured), grid.on_gpu):
        T_ji, depth = keyframes.relative_poses(part), keyframes.inverse_depths([i for i, _ in part])
        shifts = bend.of_matches(grid.camera, grid.rays, T_ji, depth)
        if rows is not None and longer != 0:
            i, j = ([keyframes[pair[k]].frame_index for pair in part] for k in (0, 1))
            pixels, _ = edge_matches(grid, [measured[pair] for pair in part])
            found = rows.of_matches(i, j, T_ji, grid.rays, depth, pixels)
            shifts = shifts + longer * found.slope
        for pair, shift in zip(part, shifts, strict=True):
            graph.edges[pair] = measured[pair].moved(grid.camera, shift)
