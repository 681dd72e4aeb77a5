"""Bundle adjustment over all keyframes, with flow measured anew from round to round."""

from collections.abc import Callable, Sequence
from functools import partial

from geogs.bundle.protocols import BundleOptions
from geogs.loop.frame_lenses import VaryingLens, correct_frame_lenses
from geogs.loop.lens_correction import correct_lens
from geogs.loop.row_correction import correct_rows, let_lenses_move
from geogs.loop.straightening import BentImages, straighten
from geogs.tracking.graph.frame_graph import HUBER
from geogs.tracking.graph.proximity import RADIUS, proximity_pairs
from geogs.tracking.tracker import Tracker
from geogs.types import PoseCorrection
from geogs.world.edges import Pair

ROUNDS = 4
"""Most rounds of flow and adjustment: each sharpens the next, later ones by little."""
REMEASURE = 0.25
"""A pair is matched again when its reprojection has moved by this many pixels."""
MAX_DISTANCE = 0.5
"""Largest frame distance of a pair, of the long edge."""
SUPPRESSION = 3
"""Pairs within this many keyframes of a chosen one are left out, as they say the same."""
PAIRS = 10
"""Most pairs per keyframe: time against precision."""
MATCHED_TOGETHER = 16, 48
"""Pairs that are matched in one go, on the CPU and on a GPU."""
PRIORS_TOGETHER = 32
"""Keyframes whose depths are adjusted with their priors at a time; bounds memory."""
CONVERGED = 0.02
"""The rounds end when the reprojection of no more than this fraction of the pairs still moves."""
GLOBAL_OPTIONS = BundleOptions(
    iterations=10, huber=HUBER, damping=1e-6, least_damping=1e-8, depth_damping=1e-5, tolerance=1e-5
)
"""How each round is solved; it ends with a step that moves no pose by more, in units and radians.
A drift of scale along many keyframes has a curvature far below 1e-4 of the diagonal, the less the
more they are, and carries all depths along: with the usual damping of either the steps end long
before it is gone (docs/adjustment.md)."""


def global_bundle(
    tracker: Tracker,
    progress: Callable[[float, str], None] | None = None,
    ends: bool = False,
) -> PoseCorrection:
    """Refine all keyframes of a tracker on a fresh graph that also joins places seen again.

    The pose of the first of them stays, or, in the world of a saved map, all that is of those it
    holds.
    Each round measures the pairs whose reprojection has moved and adjusts everything; every round
    sharpens the next. Poses, inverse depth and information of the tracker are updated, and its
    graph holds the fresh edges alone: one that goes on tracking needs only those that
    ``FrameGraph.retire`` leaves of them. ``progress`` is called with the fraction done and a
    message. Returns the poses before and after; scales are 1. Where it ``ends`` the tracking and a
    lens was found, everything is straightened by that, matched and adjusted once more, and what
    matches say of the lens then is taken off them and the images; so it is found in any case where
    nobody said the focal length (``KeyframeTable.focal_deviation``), first by matches at half the
    resolution. A tracker without a map is left alone, and one whose images are straight already.
    """
    config, segment, store = tracker.config, tracker.segment, tracker.keyframes
    ids = tracker.segment.ids
    before = {k: store[k].T_cw for k in ids}
    if not ids or store.table.lens is not None:
        return PoseCorrection({}, {}, {})
    fixed = set(segment.fixed)
    free = [k for k in ids if k not in fixed]
    free_poses = free if fixed else ids[1:]
    pairs = global_pairs(tracker)
    tracker.map.graph.edges.clear()
    tracker.map.odometry.update_scale_by_all()
    match = partial(_match, tracker, pairs, free_poses, free, progress)
    # What tells of the lens is matched anew on straight images: half the resolution is enough.
    is_open = ends and store.table.focal_deviation > 0
    match(config.fine_adjustment and not is_open)
    readout = correct_rows(
        tracker, free_poses, free, GLOBAL_OPTIONS, finds_readout=config.fine_adjustment
    )
    lens = correct_lens(tracker, free_poses, free, GLOBAL_OPTIONS, ends, readout=readout)
    varying = correct_frame_lenses(tracker, free_poses, free, GLOBAL_OPTIONS) if ends else None
    images, found = None, None if lens is None else VaryingLens(lens, {})
    if varying is not None:
        found = varying if found is None else found.followed_by(store.camera, varying)
    if found is not None and ends:
        images = BentImages.of(store)
        straighten(tracker, found.views(store.camera), images)
    if images is not None or (is_open and config.fine_adjustment):
        tracker.map.graph.edges.clear()
        match(config.fine_adjustment)
        if found is not None and found.own:
            let_lenses_move(tracker, found.own)
        correct_rows(tracker, free_poses, free, GLOBAL_OPTIONS, finds_readout=False)
    if images is not None and found is not None:
        more = None
        if varying is not None:
            more = correct_frame_lenses(tracker, free_poses, free, GLOBAL_OPTIONS, before=found)
            found = found if more is None else found.followed_by(store.camera, more)
        rest = None
        if lens is not None:
            rest = correct_lens(tracker, free_poses, free, GLOBAL_OPTIONS, ends, before=found.lens)
        if rest is not None:
            found = found.followed_by(store.camera, VaryingLens(rest, {}))
        if more is not None:
            more.shift(tracker)
        images.straighten(found.views(store.camera))
    for start in range(0, len(free), PRIORS_TOGETHER):
        tracker.map.priors.adjust(free[start : start + PRIORS_TOGETHER])  # moves no pose
    if progress is not None:
        progress(1.0, "all keyframes adjusted")
    after = {k: store[k].T_cw for k in ids}
    correction = PoseCorrection(before, after, dict.fromkeys(ids, 1.0), of_all=True)
    store.correct(correction)
    return correction


def _match(
    tracker: Tracker,
    pairs: Sequence[Pair],
    free_pose: Sequence[int],
    free_depth: Sequence[int],
    progress: Callable[[float, str], None] | None,
    fine: bool,
) -> None:
    """Measure pairs and adjust everything, from round to round those that have moved.

    At full resolution where it is ``fine``, else at half of it; small images always at full.
    """
    config, graph, odometry = tracker.config, tracker.map.graph, tracker.map.odometry
    batch = MATCHED_TOGETHER[tracker.keyframes.grid.on_gpu]
    for n in range(ROUNDS if pairs else 0):
        # Pairs of the same keyframe one after the other: images of old ones are read from a file.
        stale = sorted(graph.stale(pairs, REMEASURE))
        if len(stale) <= CONVERGED * len(pairs):
            break
        for start in range(0, len(stale), batch):
            part = stale[start : start + batch]
            graph.measure(part, fine=fine, packed=True)
            if progress is not None:
                done = (n + start / len(stale)) / ROUNDS
                progress(done, "matching all keyframes")
        graph.adjust(list(graph.edges), free_pose, free_depth, GLOBAL_OPTIONS)
        graph.update_dynamic(set(free_depth), config.moving)
        odometry.update_scale_by_all()


def global_pairs(tracker: Tracker) -> list[Pair]:
    """Neighbours in time and all places seen again, thinned evenly; not within a saved map."""
    grid, ids = tracker.keyframes.grid, tracker.segment.ids
    pairs = proximity_pairs(
        tracker.keyframes,
        ids,
        ids,
        [],
        RADIUS,
        SUPPRESSION,
        MAX_DISTANCE * max(grid.camera.width, grid.camera.height),
        PAIRS * len(ids),
    )
    wanted, fixed = set(ids), set(tracker.segment.fixed)
    return [p for p in pairs if wanted.issuperset(p) and not fixed.issuperset(p)]
