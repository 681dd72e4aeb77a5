"""Bundle adjustment over all keyframes, with flow measured again in every round."""

from geogs.loop.camera.adjustment import adjust_camera
from geogs.loop.keyframe_matches import STAGE, KeyframeMatches
from geogs.stopwatch import StageProgress, unwatched
from geogs.tracking.tracker import Tracker
from geogs.types import PoseCorrection

PRIORS_TOGETHER = 32
"""Keyframes whose depths are adjusted with their priors at a time; bounds memory."""


def global_bundle(
    tracker: Tracker, progress: StageProgress = unwatched, ends: bool = False
) -> PoseCorrection:
    """Refine all keyframes of a tracker on a fresh graph that also links revisited places.

    The first pose is fixed or, in the world of a saved map, all its keyframes. Poses, inverse depth
    and information of the tracker are updated, and its graph only has the fresh edges; further
    tracking only needs those that ``FrameGraph.retire`` keeps. Returns the poses before and after;
    scales are 1. Where it ``ends`` the tracking, images are straightened by the camera estimated
    from the matches (:func:`~geogs.loop.camera.adjustment.adjust_camera`). A tracker without a map,
    or with straightened images, is not changed.
    """
    store, ids = tracker.keyframes, tracker.segment.ids
    if not ids or store.table.lens is not None:
        return PoseCorrection({}, {}, {})
    before = {k: store[k].T_cw for k in ids}
    tracker.map.odometry.update_scale_by_all()
    matches = KeyframeMatches.of(tracker, progress)
    adjust_camera(matches, ends)
    free = matches.free_depth
    for start in range(0, len(free), PRIORS_TOGETHER):
        tracker.map.priors.adjust(free[start : start + PRIORS_TOGETHER])  # moves no pose
    progress(STAGE, 1.0)
    after = {k: store[k].T_cw for k in ids}
    correction = PoseCorrection(before, after, dict.fromkeys(ids, 1.0), of_all=True)
    store.correct(correction)
    return correction
