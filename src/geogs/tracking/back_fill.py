"""Frames from before a map was started that its keyframes nevertheless see."""

import torch

from geogs.geometry.lie import se3_inverse
from geogs.tracking.motion import FrameLocator
from geogs.tracking.trajectory import TrajectoryRecorder
from geogs.tracking.turns import orientations
from geogs.tracking.view_choice import seeing


def back_fill(recorder: TrajectoryRecorder, locator: FrameLocator, min_known: float) -> None:
    """Locate the frames that have no place between the keyframes of a start, the latest first.

    Each is looked for where the camera was at the nearest time that is known, turned as turns say.
    """
    waiting = recorder.take_unplaced()
    keyframes = list(recorder.keyframes)
    if not waiting or not keyframes:
        return
    turned = orientations(
        {r.index: r.turns for r in recorder.records},
        {k.frame_index: k.T_cw[:3, :3] for k in keyframes},
    )
    centres = {k.frame_index: se3_inverse(k.T_cw)[:3, 3] for k in keyframes}
    for record, encoded in reversed(waiting):
        record.anchor, R = None, turned.get(record.index)
        if R is None:
            continue
        nearest = min(centres, key=lambda index: abs(index - record.index))
        guess = torch.eye(4, dtype=torch.float64)
        guess[:3, :3], guess[:3, 3] = R, -R @ centres[nearest]
        for keyframe in seeing(keyframes, guess):
            motion = locator.locate(keyframe, encoded, guess, is_expected=False)
            if motion is not None and motion.known >= min_known:
                T_rel = motion.T_cw @ se3_inverse(keyframe.T_cw)
                recorder.place(record, keyframe.id, T_rel, motion.match)
                centres[record.index] = se3_inverse(motion.T_cw)[:3, 3]
                break
