"""Frames from before a map was started that its keyframes nevertheless see."""

import torch

from geogs.geometry.lie import se3_inverse
from geogs.tracking.motion import FrameLocator
from geogs.tracking.trajectory import TrajectoryRecorder
from geogs.tracking.turns import orientations
from geogs.tracking.view_choice import seeing

MAX_MISSES = 5
"""Frames on end that cannot be located before the earlier ones are left without a position."""


def back_fill(recorder: TrajectoryRecorder, locator: FrameLocator, min_known: float) -> None:
    """Locate the frames that belong to keyframes which were given up, the latest first.

    Each is looked for where the one after it was, turned as turns say.
    """
    waiting = recorder.take_unplaced()
    keyframes = list(recorder.keyframes)
    if not waiting or not keyframes:
        return
    turned = orientations(
        {r.index: r.turns for r in recorder.records},
        {k.frame_index: k.T_cw[:3, :3] for k in keyframes},
    )
    centre = se3_inverse(keyframes[0].T_cw)[:3, 3]
    misses = 0
    for record, encoded in reversed(waiting):
        R = turned.get(record.index)
        if misses == MAX_MISSES or R is None or record.index > keyframes[0].frame_index:
            continue
        guess = torch.eye(4, dtype=torch.float64)
        guess[:3, :3], guess[:3, 3] = R, -R @ centre
        misses += 1
        for keyframe in seeing(keyframes, guess):
            motion = locator.locate(keyframe, encoded, guess, is_expected=False)
            if motion is not None and motion.known >= min_known:
                T_rel = motion.T_cw @ se3_inverse(keyframe.T_cw)
                recorder.place(record, keyframe.id, T_rel, motion.match)
                centre, misses = se3_inverse(motion.T_cw)[:3, 3], 0
                break
