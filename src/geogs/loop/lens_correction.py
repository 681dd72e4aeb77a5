"""The lens in the adjustment of all keyframes, where the matches say that it bends otherwise.

Images were undistorted by what was said of the lens, which may be nothing. What is left is a small
k1 and k2 that all matches of the video tell together. They are taken off the matches, and
everything is adjusted again; flow and focal length stay as they are. Until then a walk straight on
drifts in scale (docs/tracking.md).
"""

from collections.abc import Sequence

from geogs.bundle.protocols import BundleOptions
from geogs.bundle.uncertainty.lens_error import LensBend
from geogs.tracking.frames.pose_filling import shift_lens
from geogs.tracking.frames.row_errors import TOGETHER
from geogs.tracking.graph.frame_graph import FrameGraph
from geogs.tracking.keyframe_uncertainty import lens_estimate
from geogs.tracking.tracker import Tracker
from geogs.types import FoundLens
from geogs.world.edges import PackedEdge, Pair

ROUNDS = 3
"""Each is to first order; the second and third take a fifth and a twentieth of what the first
does."""
EVIDENCE = 81.0
"""Square of the sizes in their deviations from which on they are believed. Matches of different
keyframes err alike, too: where the lens was known it is 1 to 10, where it was not, hundreds
(docs/tracking.md)."""


def correct_lens(
    tracker: Tracker,
    free_pose: Sequence[int],
    free_depth: Sequence[int],
    options: BundleOptions,
) -> FoundLens | None:
    """Correct all matches for the lens and adjust again; nothing where they do not ask for it.

    What was measured of the frames between the keyframes is corrected, too. Not in the world of a
    saved map, whose keyframes stay as its own adjustment left them.
    """
    graph, keyframes = tracker.map.graph, tracker.keyframes
    measured = graph.packed
    bend, deviation = LensBend(), (0.0, 0.0)
    for n in range(ROUNDS if measured and not tracker.segment.fixed else 0):
        said = lens_estimate(tracker, list(free_depth))
        if said is None or (n == 0 and said.evidence < EVIDENCE):
            break
        bend = bend.plus(said.size)
        k1, k2 = said.covariance.diagonal().sqrt().tolist()
        deviation = k1, k2
        _shift(graph, measured, bend)
        graph.adjust(list(graph.edges), free_pose, free_depth, options)
    if bend == LensBend():
        return None
    shift_lens(tracker.map.recorder.log, keyframes, bend)
    return FoundLens(bend.k1, bend.k2, *deviation)


def _shift(graph: FrameGraph, measured: dict[Pair, PackedEdge], bend: LensBend) -> None:
    """Have the measured edges with their matches where a pinhole would have them."""
    grid, keyframes, pairs = graph.keyframes.grid, graph.keyframes, sorted(measured)
    for start in range(0, len(pairs), TOGETHER):
        part = pairs[start : start + TOGETHER]
        T_ji, depth = keyframes.relative_poses(part), keyframes.inverse_depths([i for i, _ in part])
        shifts = bend.of_matches(grid.camera, grid.rays, T_ji, depth)
        for pair, shift in zip(part, shifts, strict=True):
            graph.edges[pair] = measured[pair].moved(grid.camera, shift)
