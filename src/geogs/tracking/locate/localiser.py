"""Localisation of the camera in a started map: near its last pose, or anywhere when it is lost."""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.device_choice import grid_fields
from geogs.tracking.keyframes.segment_map import SegmentMap
from geogs.tracking.locate.frame_locator import FrameLocator, FrameMotion, Recognition, with_depth
from geogs.tracking.locate.orientation_follower import Followed
from geogs.tracking.matching.flow_chain import MIN_MATCHED
from geogs.tracking.matching.photometric_check import MIN_NCC
from geogs.types import Frame
from geogs.world.keyframes import Keyframe, KeyframeSet

MAX_RESIDUAL = 0.008
"""Median reprojection error above which the camera is lost, as a fraction of the long edge."""
MIN_RECOGNISED = 0.25
"""Fraction of a recognised keyframe's cells that must be matched: twice the fraction required where
the camera was expected."""
MAX_TRIED = 5
"""Recent keyframes, and as many older ones in turn, tried when the camera is lost."""
MAX_FACING, MAX_VISIBLE = 12, 2
"""Keyframes whose viewing direction is nearest to a camera's, and those of them with the largest
overlap, which are matched."""
MIN_OVERLAP = 0.15
"""Fraction of a keyframe's cells that must have known depth and fall into the image."""
RELOCALISE_EVERY = 5
"""Interval in frames of a search in the whole map while a camera only rotates; otherwise its
orientation gives the view."""


class SegmentLocaliser:
    """Locates frames at the keyframes of a segment."""

    def __init__(self, map: SegmentMap) -> None:
        self.map = map
        grid = map.keyframes.grid
        max_residual = MAX_RESIDUAL * grid.camera.long_edge
        self.locator = FrameLocator(grid, map.operator, MIN_MATCHED, max_residual, MIN_NCC)

    def track(self, frame: Frame, encoded: Any) -> FrameMotion | None:
        """Locate the frame near the last one; None if the camera is not there."""
        last = self.map.segment.status.last
        if last is None:
            return None
        keyframe = self.map.keyframes[last.keyframe]
        locate = self.locator.locate
        motion = locate(keyframe, encoded, last.predicted(keyframe, frame.timestamp))
        if motion is None:
            given = self.map.odometry.since(keyframe, frame.pose)
            if given is not None:
                motion = locate(keyframe, encoded, given @ keyframe.T_cw)
        if motion is None and last.velocity is not None:
            motion = locate(keyframe, encoded, last.T_cw(keyframe))
        return self.locator.best(keyframe, encoded, with_depth(motion))

    def relocalise(self, encoded: Any, followed: Followed | None) -> FrameMotion | None:
        """Locate the frame anywhere: first at the pose of a pure rotation."""
        status = self.map.segment.status
        last = status.last
        if last is not None and followed is not None and followed.R is not None:
            rotation = torch.eye(4, dtype=torch.float64)
            rotation[:3, :3] = followed.R
            guess = rotation @ last.T_cw(self.map.keyframes[last.keyframe])
            for keyframe in visible_keyframes(self.map.keyframes, guess):
                motion = self.locator.locate(keyframe, encoded, guess, is_expected=False)
                if with_depth(motion) is not None:
                    return motion
            if followed.is_pure and status.misses % RELOCALISE_EVERY:
                return None
        return with_depth(self.locator.relocate_any(self._candidates(), encoded))

    def recognise(self, encoded: Any, recognised: Sequence[Recognition]) -> FrameMotion | None:
        """Locate the frame at one of some recognised keyframes.

        One is accepted if the dense flow agrees with it over ``MIN_RECOGNISED`` of the cells.
        """
        for candidate in recognised:
            if candidate.keyframe not in self.map.keyframes:
                continue
            keyframe = self.map.keyframes[candidate.keyframe]
            motion = with_depth(self.locator.locate_relative(keyframe, encoded, candidate.T_rel))
            if motion is not None and motion.matched >= MIN_RECOGNISED:
                return motion
        return None

    def _candidates(self) -> list[Keyframe]:
        """Return keyframes to search for a lost camera: recent ones, and older ones in turn."""
        keyframes = list(self.map.keyframes)
        recent = keyframes[: -MAX_TRIED - 1 : -1]
        older = keyframes[:-MAX_TRIED]
        first = (self.map.segment.status.misses * MAX_TRIED) % max(len(older), 1)
        return recent + (older[first:] + older[:first])[:MAX_TRIED]


def visible_keyframes(keyframes: KeyframeSet, T_cw: Float[Tensor, "4 4"]) -> list[Keyframe]:
    """Return the keyframes most of whose known depth falls into a camera's image, best first."""
    if not len(keyframes):
        return []
    grid = keyframes.grid
    ids = keyframes.ids
    along = keyframes.poses(ids)[:, 2, :3] @ T_cw[2, :3]
    nearest = along.argsort(descending=True, stable=True)[:MAX_FACING].tolist()
    facing = [keyframes[ids[n]] for n in nearest]
    there, _ = grid_fields(grid).reproject(facing, [T_cw] * len(facing))
    known = torch.stack([k.has_known_depth for k in facing])
    seen = (grid.inside(there) & known).float().mean(1).tolist()
    ranked = sorted(zip(seen, facing, strict=True), key=lambda pair: -pair[0])
    return [k for fraction, k in ranked[:MAX_VISIBLE] if fraction >= MIN_OVERLAP]
