"""Where the camera was last seen, and where it is expected next."""

from dataclasses import dataclass

from jaxtyping import Float, Float64
from torch import Tensor

from geogs.geometry.lie import se3_exp, se3_log
from geogs.world.keyframes import Keyframe

SAME_PACE = 0.2
"""Part by which a frame may come sooner or later than the one before without a word: time stamps
are rounded."""
LONGEST_STEP = 3.0
"""Of the last motion that is expected at most, however long no frame came."""


@dataclass(frozen=True)
class LastFrame:
    """Where the camera was last seen, relative to a keyframe, so that corrections carry it."""

    keyframe: Keyframe
    T_rel: Float[Tensor, "4 4"]
    """Keyframe to this frame."""
    velocity: Float[Tensor, "4 4"] | None
    """Motion from the frame before; None where the camera had been lost."""
    scale: float
    """Of the keyframe when the two were measured."""
    timestamp: float
    """Seconds."""
    interval: float
    """Seconds that the motion took."""

    @property
    def T_cw(self) -> Float[Tensor, "4 4"]:
        """World to camera by the keyframe's present pose and scale."""
        return self._present(self.T_rel) @ self.keyframe.T_cw

    def predicted(self, timestamp: float) -> Float[Tensor, "4 4"]:
        """World to camera of the next frame, at a time, if the motion goes on."""
        if self.velocity is None:
            return self.T_cw
        motion = self._present(self.velocity)
        ratio = (timestamp - self.timestamp) / self.interval if self.interval > 0 else 1.0
        if abs(ratio - 1) > SAME_PACE:
            motion = se3_exp(min(max(ratio, 0.0), LONGEST_STEP) * se3_log(motion))
        return motion @ self.T_cw

    def _present(self, T: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
        return self.keyframe.at_present_scale(T, self.scale)


@dataclass(frozen=True, eq=False)
class LastFrameState:
    """What a checkpoint holds of where the camera was last seen; the fields are a last frame's."""

    keyframe: int
    T_rel: Float64[Tensor, "4 4"]
    velocity: Float64[Tensor, "4 4"] | None
    scale: float
    timestamp: float
    interval: float
