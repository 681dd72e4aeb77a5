"""Frames of a video: what is kept of each to place it once the keyframes around it are final."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float, Float16, Float64, Int16, UInt8
from torch import Tensor

from geogs.errors import InputError
from geogs.types import SeenRows
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import Keyframe


@dataclass(eq=False)
class RelativeRotation:
    """Rotation of a frame's camera relative to that of an earlier frame."""

    frame: int
    """Index of the earlier."""
    R: Float64[Tensor, "3 3"]
    """The earlier camera to this one."""
    deviation: float
    """Standard deviation of the angle, radians."""


@dataclass(eq=False)
class Observation:
    """Flow from a keyframe to a frame on every second cell, packed as in ``edges.py``."""

    keyframe: int
    position: Int16[Tensor, "s 2"]
    half_weight: Float16[Tensor, "s 2"]
    shift: Int16[Tensor, "s 2"] | None = None
    """Steps to be added to the position, for the rows of a rolling shutter."""

    @property
    def shifted(self) -> Int16[Tensor, "s 2"]:
        """The position with its shift."""
        return self.position if self.shift is None else self.position + self.shift


@dataclass(eq=False)
class FrameRecord:
    """One frame of the stream."""

    index: int
    timestamp: float
    anchor: int | None
    """Keyframe that the pose is relative to; None where the frame was not tracked."""
    T_rel: Float[Tensor, "4 4"]
    """Anchor keyframe to this frame."""
    scale: float = 1.0
    """Scale of the anchor when that was measured."""
    observations: list[Observation] = field(default_factory=list)
    rotations: list[RelativeRotation] = field(default_factory=list)
    """Relative to earlier frames: what is left to go by where there is no depth."""
    image: UInt8[np.ndarray, "h w 3"] | None = None
    """Kept until the keyframes around are final and the flow from them is measured."""
    encoded: Any = field(default=None, metadata={"stored": False})
    """The flow operator's form of the image, or None where it has to be computed again."""

    def observes(self, keyframe: int) -> bool:
        """Whether the flow from that keyframe has been measured."""
        return any(o.keyframe == keyframe for o in self.observations)

    def T_cw(self, anchor: Keyframe) -> Float[Tensor, "4 4"]:
        """World to camera by the present pose and scale of its anchor."""
        return anchor.at_present_scale(self.T_rel, self.scale) @ anchor.T_cw

    def forget_image(self) -> None:
        """Free the image, once nothing is left to be measured in it."""
        self.image = self.encoded = None


@dataclass(eq=False)
class FrameLog:
    """All frames of a segment of video."""

    records: list[FrameRecord] = field(default_factory=list)
    rows: dict[int, SeenRows] = field(default_factory=dict)
    """Rectified rows of a rolling shutter, by the indices of the frames."""


def check_frames(records: Sequence[FrameRecord], grid: SampleGrid) -> None:
    """Raise InputError where frames are of another camera than the grid's."""
    camera = grid.camera
    cells = -(-grid.height // 2) * -(-grid.width // 2)
    seen = {len(o.position) for record in records for o in record.observations}
    images = {record.image.shape[:2] for record in records if record.image is not None}
    if seen - {cells} or images - {(camera.height, camera.width)}:
        raise InputError("the frames are of another camera")
