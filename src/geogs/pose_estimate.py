"""Estimate of the camera's pose right after a frame."""

from dataclasses import dataclass, field
from functools import cached_property
from math import inf, nan

import numpy as np
from jaxtyping import Float64

from geogs.tracking.locate.pose_deviation import DeviationOf, PoseDeviation
from geogs.world.segments import TrackState


@dataclass(frozen=True, repr=False)
class PoseEstimate:
    """A frame's pose and the size of the map at that time.

    Later frames, loops and the final adjustment change it: ``Slam.trajectory`` gives the current
    poses of all frames.
    """

    state: TrackState
    frames: int
    keyframes: int
    disks: int
    timestamp: float = nan
    """Seconds."""
    T_cw: Float64[np.ndarray, "4 4"] | None = field(default=None, compare=False)
    """World to camera; None unless the camera is tracked in the main map."""
    deviation: DeviationOf | None = field(default=None, repr=False, compare=False)
    """Function for the standard deviations of the pose; None where they are unknown."""

    def __repr__(self) -> str:
        counts = f"{self.frames} frames, {self.keyframes} keyframes, {self.disks} disks"
        return f"PoseEstimate({self.state.value} at {self.timestamp:g} s: {counts})"

    @property
    def T_wc(self) -> Float64[np.ndarray, "4 4"] | None:
        """Camera to world."""
        return None if self.T_cw is None else np.linalg.inv(self.T_cw)

    @property
    def is_tracked(self) -> bool:
        """Whether there is a pose."""
        return self.T_cw is not None

    @property
    def sigma_position(self) -> float:
        """Standard deviation of the camera's centre relative to the map around it, map units, all
        axes together; infinite where unknown."""
        return inf if self._deviation is None else float(self._deviation.position)

    @property
    def sigma_rotation(self) -> float:
        """Standard deviation of its orientation, radians; infinite where unknown."""
        return inf if self._deviation is None else float(self._deviation.rotation)

    @cached_property
    def _deviation(self) -> PoseDeviation | None:
        return None if self.deviation is None else self.deviation()
