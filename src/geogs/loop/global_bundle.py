"""Bundle adjustment over all keyframes, with flow measured again in every round."""

import math
from dataclasses import replace

import torch

from geogs.loop.camera.frame_lenses import correct_frame_lenses
from geogs.loop.camera.lens import correct_lens, found_lens
from geogs.loop.camera.rows import correct_rows, let_lenses_move
from geogs.loop.keyframe_matches import STAGE, KeyframeMatches
from geogs.stopwatch import StageProgress, unwatched
from geogs.tracking.tracker import Tracker
from geogs.types import FrameLens, PoseCorrection

PRIORS_TOGETHER = 32
"""Keyframes whose depths are adjusted with their priors at a time; bounds memory."""


def global_bundle(
    tracker: Tracker, progress: StageProgress = unwatched, ends: bool = False
) -> PoseCorrection:
    """Refine all keyframes of a tracker on a fresh graph that also links revisited places.

    The first pose is fixed or, in the world of a saved map, all its keyframes. Poses, inverse depth
    and information of the tracker are updated, and its graph only has the fresh edges; further
    tracking only needs those that ``FrameGraph.retire`` keeps. Returns the poses before and after;
    scales are 1. Where it ``ends`` the tracking, the map's images are straightened by the camera
    estimated from the matches (:func:`~geogs.loop.global_bundle.adjust_camera`). A tracker without
    a map, or with an estimated camera, is not changed.
    """
    store = tracker.keyframes
    ids = tracker.segment.ids
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


def adjust_camera(matches: KeyframeMatches, ends: bool) -> None:
    """Match all keyframes, and estimate the camera from the matches.

    Matches always belong to the images as tracked: an estimated camera becomes that of the grid.
    Where this ``ends`` the tracking and a correction was found, pairs that have moved are matched
    again, everything is adjusted once more, and images are straightened for the map. Where the
    focal length was not given (``KeyframeTable.focal_deviation``) the first matches are at half the
    resolution, and all are measured again.
    """
    table = matches.keyframes.table
    fine = matches.tracker.config.fine_adjustment
    is_open = ends and table.focal_deviation > 0
    matches.measure(fine and not is_open)
    readout = correct_rows(matches, finds_readout=fine)
    lens = correct_lens(matches, ends, readout=readout)
    if not ends:
        matches.graph.see_by(table.assumed)
        return
    own = correct_frame_lenses(matches)
    if lens or own or (is_open and fine):
        matches.measure(fine, anew=is_open and fine)
        let_lenses_move(matches, own.each)
        correct_rows(matches, finds_readout=False)
    if own:
        own = correct_frame_lenses(matches, own)
    if lens:
        lens = correct_lens(matches, ends, before=lens) or lens
    if lens or own:
        found = found_lens(table.assumed, matches.camera, lens)
        sizes = torch.tensor([o.sizes for o in own.each.values()] or [FrameLens().sizes])
        focal, right, down = sizes.double().square().mean(0).sqrt().tolist()
        found = replace(found, varies_focal=focal, varies_centre=math.hypot(right, down))
        frame = {k.id: k.frame_index for k in matches.keyframes}
        table.straighten(found, {k: own.each[n] for k, n in frame.items() if n in own.each})
