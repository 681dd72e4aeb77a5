"""How far back the local adjustment reaches."""

from collections.abc import Sequence

import torch

from geogs.geometry.lie import se3_inverse
from geogs.world.keyframes import Keyframe


def reach(keyframes: Sequence[Keyframe], least: int, most: int, baseline: float) -> int:
    """How many of the latest keyframes are adjusted together, earliest of all first.

    As many as it takes until the camera has moved from one of them to the newest by ``baseline`` of
    the newest's median depth, so that together they say something about depth: a camera that
    turns makes many keyframes at one place. Between ``least`` and ``most``, or all there are.
    """
    count = min(least, len(keyframes))
    if baseline == 0 or count == len(keyframes):
        return count
    newest = keyframes[-1]
    known = newest.information > 0
    if not bool(known.any()):
        return count
    far = baseline / float(newest.inverse_depth[known].median().clamp(min=1e-9))
    here = se3_inverse(newest.T_cw)[:3, 3]
    for back in range(1, min(most, len(keyframes)) + 1):
        there = se3_inverse(keyframes[-back].T_cw)[:3, 3]
        if float(torch.linalg.norm(there - here)) >= far:
            return max(count, back)
    return max(count, min(most, len(keyframes)))
