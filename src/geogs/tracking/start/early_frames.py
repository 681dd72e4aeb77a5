"""Poses of the frames between the keyframes of a start."""

import torch

from geogs.geometry.lie import retract, se3_inverse, se3_log, so3_log
from geogs.tracking.frames.rotation_averaging import orientations
from geogs.world.frames import FrameLog
from geogs.world.keyframes import KeyframeSet

MAX_DISAGREEMENT = 0.05
"""Largest difference, in radians, of a frame's orientation from the interpolated one."""


def place_between_keyframes(log: FrameLog, keyframes: KeyframeSet) -> None:
    """Interpolate poses of the frames of a start between their keyframes.

    A frame whose relative rotations contradict its pose loses it: the camera then faced away from
    both keyframes.
    """
    ordered = list(keyframes)
    indices = [k.frame_index for k in ordered]
    oriented = orientations(
        {r.index: r.rotations for r in log.records},
        {k.frame_index: k.T_cw[:3, :3] for k in ordered},
    )
    for record in log.records:
        if record.anchor is None or record.anchor not in keyframes:
            continue
        n = indices.index(keyframes[record.anchor].frame_index)
        a, b = ordered[n], ordered[min(n + 1, len(ordered) - 1)]
        span = max(b.frame_index - a.frame_index, 1)
        fraction = (record.index - a.frame_index) / span
        xi = se3_log(b.T_cw @ se3_inverse(a.T_cw))
        record.T_rel, record.scale = retract(fraction * xi, torch.eye(4).to(xi)), a.scale
        R = oriented.get(record.index)
        if R is not None:
            angle = so3_log(R @ (record.T_rel @ a.T_cw)[:3, :3].mT).norm()
            if float(angle) > MAX_DISAGREEMENT:
                record.anchor = None
