"""Follows the orientation of a camera where there is no depth to locate it by."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float64
from torch import Tensor

from geogs.config import TrackingConfig
from geogs.tracking.flow.flow_operator import FlowOperator
from geogs.tracking.keyframes.keyframe_choice import calls_for_keyframe
from geogs.tracking.matching.flow_chain import MIN_MATCHED, follow_flow
from geogs.tracking.matching.two_view_rotation import two_view_rotation
from geogs.types import Frame
from geogs.world.frames import RelativeRotation
from geogs.world.grid import SampleGrid
from geogs.world.segments import OrientationTrack, ReferenceView

MAX_MISSES = 5
"""Frames that do not match the view after which the next one replaces it, without a link."""


@dataclass(frozen=True)
class Followed:
    """Orientation of a frame."""

    rotation: RelativeRotation
    """Relative to the view it was matched with."""
    R: Float64[Tensor, "3 3"] | None
    """The camera that was located last to this frame; none where nothing links them."""
    is_pure: bool
    """Whether nothing speaks for more than a rotation."""


class OrientationFollower:
    """Matches each frame with one view before it, and takes another when that leaves the image.

    So the error grows with the number of views, not with that of frames.
    """

    def __init__(self, grid: SampleGrid, operator: FlowOperator, config: TrackingConfig) -> None:
        self.grid, self.operator, self.config = grid, operator, config

    def located(self, track: OrientationTrack, frame: Frame, encoded: Any) -> None:
        """The frame has a pose: what follows may be matched with it."""
        eye = torch.eye(3, dtype=torch.float64)
        track.reset(ReferenceView(frame.index, frame.image, eye, encoded))

    def follow(self, track: OrientationTrack, frame: Frame, encoded: Any) -> Followed | None:
        """Rotation of the next frame relative to the view; None if that is not known."""
        view = track.view
        if view is None:
            track.reset(ReferenceView(frame.index, frame.image, None, encoded))
            return None
        if view.encoded is None:
            view.encoded = self.operator.encode(view.image)
        match = follow_flow(self.grid, self.operator, track.flow, view.encoded, encoded)
        found = None
        if match.matched >= MIN_MATCHED:
            found = two_view_rotation(self.grid, match.there)
        if found is None:
            track.misses += 1
            if track.misses >= MAX_MISSES:
                track.reset(ReferenceView(frame.index, frame.image, None, encoded))
            return None
        track.misses = 0
        R = None if view.R is None else found.R @ view.R
        if calls_for_keyframe(self.config, self.grid, match.seen):
            track.reset(ReferenceView(frame.index, frame.image, R, encoded))
        rotation = RelativeRotation(view.index, found.R, found.deviation)
        return Followed(rotation, R, found.is_pure)
