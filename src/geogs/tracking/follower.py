"""Localisation of frames while another thread completes a new keyframe."""

from dataclasses import dataclass
from typing import Any

from jaxtyping import Float
from torch import Tensor

from geogs.config import TrackingConfig
from geogs.geometry.lie import se3_inverse
from geogs.tracking.keyframes.keyframe_choice import calls_for_keyframe
from geogs.tracking.locate.frame_locator import FrameLocator, FrameMotion, with_depth
from geogs.tracking.locate.pose_deviation import DeviationOf, deviation_of
from geogs.tracking.matching.flow_chain import MIN_TEXTURE
from geogs.types import Frame
from geogs.world.keyframes import Keyframe
from geogs.world.segments import LastFrame

PATIENCE = 1.0
"""Relative excess over the keyframe distance that a frame may have from the unfinished keyframe."""
MAX_FRAMES = 60
"""Most frames whose images wait with a follower."""


@dataclass(frozen=True)
class FollowedFrame:
    """A frame and its pose."""

    frame: Frame
    encoded: Any
    motion: FrameMotion
    T_rel: Float[Tensor, "4 4"]
    """New keyframe to this frame, in the keyframe's lengths when the follower was made."""


class Follower:
    """Locates frames by a copy of a new keyframe, which is being completed meanwhile.

    It changes no shared data: the tracker takes over its results when the keyframe is finished.
    """

    def __init__(
        self,
        locator: FrameLocator,
        config: TrackingConfig,
        last: LastFrame,
        keyframe: Keyframe,
        anchor: Keyframe,
        motion: FrameMotion,
    ) -> None:
        """``last`` is relative to ``keyframe``, the new one; ``motion`` located its frame at
        another, ``anchor``. Neither keyframe may change any more."""
        self.last = last
        """Pose of the last frame, relative to the copied keyframe."""
        self.frames: list[FollowedFrame] = []
        """Frames located so far, earliest first."""
        self._locator = locator
        self._config = config
        self._keyframe = keyframe
        self._anchor = anchor
        self._motion = motion

    @property
    def T_cw(self) -> Float[Tensor, "4 4"]:
        """World to camera of the last frame, by the copied keyframe."""
        return self.last.T_cw(self._keyframe)

    def follow(self, frame: Frame) -> FollowedFrame | None:
        """Locate the next frame; None where the unfinished keyframe is not enough.

        That is where the camera is far from its predicted pose, or has moved so far that another
        keyframe is overdue, and after a cut.
        """
        last = self.last
        locator = self._locator
        keyframe = self._keyframe
        camera = keyframe.grid.camera
        is_sensed = frame.depth is not None and keyframe.measured is None
        has_size = frame.image.shape[:2] == (camera.height, camera.width)
        if frame.follows_cut or is_sensed or not has_size or len(self.frames) >= MAX_FRAMES:
            return None
        encoded = locator.operator.encode(frame.image)
        if locator.operator.texture(encoded) < MIN_TEXTURE:
            return None
        guess = last.predicted(keyframe, frame.timestamp)
        expected = with_depth(locator.locate(keyframe, encoded, guess))
        motion = locator.best(keyframe, encoded, expected)
        if motion is None or calls_for_keyframe(self._config, keyframe.grid, motion, PATIENCE):
            return None
        velocity = motion.T_cw @ se3_inverse(self.T_cw)
        T_rel = motion.T_cw @ se3_inverse(keyframe.T_cw)
        interval = frame.timestamp - last.timestamp
        self.last = LastFrame(
            keyframe.id, T_rel, velocity, keyframe.scale, frame.timestamp, interval
        )
        self._anchor = keyframe
        self._motion = motion
        self.frames.append(FollowedFrame(frame, encoded, motion, T_rel))
        return self.frames[-1]

    def deviation(self) -> DeviationOf:
        """Return a function for the deviations of the last pose relative to its keyframe."""
        return deviation_of(self._anchor.grid, self._anchor, self._motion)
