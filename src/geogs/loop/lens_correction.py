"""The lens in the adjustment of all keyframes, where the matches say that it bends otherwise.

Images were undistorted by what was said of the lens, which may be nothing. What is left is a small
k1 and k2 that all matches of the video tell together. They are taken off the matches, and
everything is adjusted again; flow stays as it is. Until then a walk straight on drifts in scale.
The focal length is corrected with them where they ask for that, too: one that was found while the
lens was taken for a pinhole is off by several percent (docs/tracking.md).
"""

import math
from collections.abc import Sequence
from dataclasses import replace

from geogs.bundle.protocols import BundleOptions
from geogs.bundle.uncertainty.lens_error import LensBend
from geogs.tracking.frames.pose_filling import shift_lens
from geogs.tracking.frames.row_errors import TOGETHER
from geogs.tracking.graph.frame_graph import FrameGraph
from geogs.tracking.keyframe_uncertainty import said_of_lens
from geogs.tracking.tracker import Tracker
from geogs.types import FoundLens
from geogs.world.edges import PackedEdge, Pair

ROUNDS = 8
"""At most. Each is to first order and leaves a fifth to a half of what the one before it left."""
CONVERGED = 0.2
"""Deviations by which the last round may have changed a size."""
EVIDENCE = 81.0
"""Square of the sizes in their deviations from which on they are believed. Matches of different
keyframes err alike, too: where the lens was known it is 1 to 10, where it was not, hundreds
(docs/tracking.md)."""
FOCAL_EVIDENCE = 4.0
"""Deviations from which on the focal length is believed to be off, too, where k1 and k2 are. Where
it was given it is 0 to 2.2 (docs/tracking.md)."""
FOCAL_LEFT = 0.2
"""What the focal length is off by after its correction, of the correction: a tenth and a quarter of
it in two rendered rooms, whatever matches say."""


def correct_lens(
    tracker: Tracker,
    free_pose: Sequence[int],
    free_depth: Sequence[int],
    options: BundleOptions,
    ends: bool = False,
    again: bool = False,
) -> FoundLens | None:
    """Correct all matches for the lens and adjust again; nothing where they do not ask for it.

    What was measured of the frames between the keyframes is corrected, too. The focal length is
    only where tracking ``ends`` with it: what is matched afterwards would be of another. ``again``
    says that a lens was found and images are straight, so that what matches say then is believed
    however little it is. Not in the world of a saved map, whose keyframes stay as its own
    adjustment left them.
    """
    graph, keyframes = tracker.map.graph, tracker.keyframes
    measured = graph.packed
    bend, said, focal, is_asked = LensBend(), None, 0.0, False
    left = ROUNDS if measured and not tracker.segment.fixed else 0
    while left:
        asked = said_of_lens(tracker, list(free_depth))
        if asked is None or (said is None and not again and asked.bend.evidence < EVIDENCE):
            break
        said, left = asked.whole, left - 1
        if ends and not is_asked and abs(said.size[0]) > FOCAL_EVIDENCE * said.deviation[0]:
            is_asked, left = True, ROUNDS
        if is_asked:
            focal += float(said.size[0])
            graph.refocus(math.exp(focal))
        else:
            said = asked.bend
        if bool((said.size.abs() < CONVERGED * said.deviation).all()):
            left = 0
        bend = bend.plus(said.size[-2:])
        _shift(graph, measured, bend)
        graph.adjust(list(graph.edges), free_pose, free_depth, options)
    if said is None:
        return None
    shift_lens(tracker.map.recorder.log, keyframes, bend)
    *of_focal, k1, k2 = said.deviation.tolist()
    found = FoundLens(bend.k1, bend.k2, k1, k2)
    if not is_asked:
        return found
    open_focal = math.hypot(*of_focal, FOCAL_LEFT * focal)
    return replace(found, focal=math.exp(focal), deviation_focal=open_focal)


def _shift(graph: FrameGraph, measured: dict[Pair, PackedEdge], bend: LensBend) -> None:
    """Have the measured edges with their matches where a pinhole would have them."""
    grid, keyframes, pairs = graph.keyframes.grid, graph.keyframes, sorted(measured)
    size = TOGETHER[grid.on_gpu]
    for start in range(0, len(pairs), size):
        part = pairs[start : start + size]
        T_ji, depth = keyframes.relative_poses(part), keyframes.inverse_depths([i for i, _ in part])
        shifts = bend.of_matches(grid.camera, grid.rays, T_ji, depth)
        for pair, shift in zip(part, shifts, strict=True):
            graph.edges[pair] = measured[pair].moved(grid.camera, shift)
