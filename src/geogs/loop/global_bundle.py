"""Bundle adjustment over all keyframes, with flow measured anew from round to round."""

from collections.abc import Callable

from geogs.tracking.bundle import BundleOptions
from geogs.tracking.graph import proximity_pairs
from geogs.tracking.tracker import Tracker
from geogs.types import PoseCorrection
SUPP = 3
HUBER = 3.0


def global_bundle(
    tracker: Tracker, progress: Callable[[float, str], None] | None = None
) -> PoseCorrection:
    """Refine all keyframes of a tracker on a fresh graph that also joins places seen again.

    Each round measures the pairs whose reprojection has moved and adjusts everything; every round
    sharpens the next. Poses, inverse depth and information of the tracker are updated; the first
    pose stays. Returns the poses before and after; scales are 1.
    """
    config, store, graph = tracker.config, tracker.store, tracker.graph
    ids = store.ids
    before = {k: store[k].T_cw.clone() for k in ids}
    pairs = proximity_pairs(
        store,
        ids,
        ids,
        [],
        config.radius,
        SUPP,
        config.global_distance * max(tracker.camera.width, tracker.camera.height),
        config.global_pairs * len(ids),
    )
    graph.edges = {}
    for n in range(config.global_rounds):
        graph.measure(graph.stale(pairs, 0.25), fine=True)
        graph.adjust(list(graph.edges), ids[1:], ids, BundleOptions(iterations=4, huber=HUBER))
        if progress is not None:
            progress((n + 1) / config.global_rounds, "global bundle adjustment")
    after = {k: store[k].T_cw.clone() for k in ids}
    return PoseCorrection(before, after, dict.fromkeys(ids, 1.0))
