"""Records of video frames, from which each is located once the keyframes around it are final."""

from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float, Float16, Float64, Int16, UInt8
from torch import Tensor

from geogs.config.setting import Range
from geogs.limits import RIGID, AtLeast0, KeyframeId, Number, Pose, Positive
from geogs.types import FrameLens, SeenRows
from geogs.world.arrays import NOT_STORED
from geogs.world.keyframes import Keyframe


@dataclass(eq=False)
class RelativeRotation:
    """Rotation of a frame's camera relative to that of an earlier frame."""

    frame: Number
    """Index of the earlier frame."""
    R: Annotated[Float64[Tensor, "3 3"], RIGID]
    """Rotation from the earlier camera to this one."""
    deviation: AtLeast0
    """Standard deviation of the angle, radians."""


@dataclass(eq=False)
class Observation:
    """Flow from a keyframe to a frame on every second cell, packed as in ``edges.py``."""

    keyframe: KeyframeId
    position: Int16[Tensor, "s 2"]
    half_weight: Annotated[Float16[Tensor, "s 2"], Range(0)]
    shift: Int16[Tensor, "s 2"] | None = None
    """Rolling-shutter correction of the position, in steps."""
    lens_shift: Int16[Tensor, "s 2"] | None = None
    """Correction for per-frame intrinsics, in steps."""

    @property
    def of_one_lens(self) -> Int16[Tensor, "s 2"]:
        """Position corrected for per-frame intrinsics."""
        return self.position if self.lens_shift is None else self.position + self.lens_shift

    @property
    def of_one_time(self) -> Int16[Tensor, "s 2"]:
        """Position corrected for the rolling shutter."""
        return self.position if self.shift is None else self.position + self.shift

    @property
    def shifted(self) -> Int16[Tensor, "s 2"]:
        """Position with both corrections."""
        return self.of_one_time + (self.of_one_lens - self.position)


@dataclass(eq=False)
class FrameRecord:
    """One frame of the stream."""

    index: Number
    timestamp: float
    anchor: KeyframeId | None
    """Keyframe that the pose is relative to; None where the frame was not tracked."""
    T_rel: Pose
    """Transform from the anchor keyframe to this frame."""
    scale: Positive = 1.0
    """Scale of the anchor when ``T_rel`` was measured."""
    observations: list[Observation] = field(default_factory=list)
    rotations: list[RelativeRotation] = field(default_factory=list)
    """Rotations relative to earlier frames, for frames that see no known depth."""
    image: UInt8[np.ndarray, "h w 3"] | None = None
    """Kept until the keyframes around it are final and the flow from them is measured."""
    encoded: Any = field(default=None, metadata=NOT_STORED)
    """The image encoded by the flow operator; None where it has to be computed again."""
    is_found: bool = False
    """Whether it was lost during the stream and relocalised afterwards."""

    def observes(self, keyframe: int) -> bool:
        """Whether the flow from that keyframe has been measured."""
        return any(o.keyframe == keyframe for o in self.observations)

    def T_cw(self, anchor: Keyframe) -> Float[Tensor, "4 4"]:
        """Return world to camera by the present pose and scale of its anchor."""
        return anchor.at_present_scale(self.T_rel, self.scale) @ anchor.T_cw

    def forget_image(self) -> None:
        """Free the image, once it is no longer needed."""
        self.image = self.encoded = None


@dataclass(eq=False)
class FrameLog:
    """All frames of a segment of video."""

    records: list[FrameRecord] = field(default_factory=list)
    rows: dict[Number, SeenRows] = field(default_factory=dict)
    """Rectified rows of a rolling shutter, by the indices of the frames."""
    open_rows: SeenRows | None = None
    """Rows of every frame where none are rectified and the shutter is unknown."""
    lenses: dict[Number, FrameLens] = field(default_factory=dict)
    """Per-frame intrinsics that change during readout, by the indices of the frames."""

    def set_readout(self, factor: float, doubt: float) -> None:
        """Scale the readout of all rectified rows by ``factor``; ``doubt`` is its relative standard
        error."""
        for index, rows in self.rows.items():
            self.rows[index] = replace(rows, seconds=factor * rows.seconds, doubt=doubt)
