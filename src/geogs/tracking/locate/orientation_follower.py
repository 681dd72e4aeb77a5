"""Tracking of a camera's orientation where there is no depth to locate it."""

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
"""Frames without a match after which the next frame replaces the view, without a link, or an
unsuccessful start begins anew."""


@dataclass(frozen=True)
class Followed:
    """Orientation of a frame."""

    rotation: RelativeRotation
    """Rotation relative to the matched view."""
    R: Float64[Tensor, "3 3"] | None
    """Rotation from the camera located last to this frame; None where no motion links them."""
    is_pure: bool
    """Whether the motion is explained by a rotation alone."""


class OrientationFollower:
    """Matches each frame with an earlier view, which is replaced when it leaves the image.

    So the error grows with the number of views, not with that of frames.
    """

    def __init__(self, grid: SampleGrid, operator: FlowOperator, config: TrackingConfig) -> None:
        self.grid = grid
        self.operator = operator
        self.config = config

    def located(self, track: OrientationTrack, frame: Frame, encoded: Any) -> None:
        """Use a located frame as the view for later ones."""
        eye = torch.eye(3, dtype=torch.float64)
        track.reset(ReferenceView(frame.index, frame.image, eye, encoded))

    def follow(self, track: OrientationTrack, frame: Frame, encoded: Any) -> Followed | None:
        """Estimate the rotation of the next frame relative to the view; None if not possible."""
        view = track.view
        if view is None:
            track.reset(ReferenceView(frame.index, frame.image, None, encoded))
            return None
        if view.encoded is None:
            view.encoded = self.operator.encode(view.image)
        motion = follow_flow(self.grid, self.operator, track.flow, view.encoded, encoded)
        found = None
        if motion.overlap >= MIN_MATCHED:
            found = two_view_rotation(self.grid, motion.match)
        if found is None:
            track.misses += 1
            if track.misses >= MAX_MISSES:
                track.reset(ReferenceView(frame.index, frame.image, None, encoded))
            return None
        track.misses = 0
        R = None if view.R is None else found.R @ view.R
        if calls_for_keyframe(self.config, self.grid, motion):
            track.reset(ReferenceView(frame.index, frame.image, R, encoded))
        rotation = RelativeRotation(view.index, found.R, found.deviation)
        return Followed(rotation, R, found.is_pure)
