"""Follows how a camera turns where there is no depth to locate it by."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64, UInt8
from torch import Tensor

from geogs.config import TrackingConfig
from geogs.errors import InputError
from geogs.tracking.flow.base import FlowOperator
from geogs.tracking.keyframe_choice import calls_for_keyframe
from geogs.tracking.motion import ChainState, FlowChain
from geogs.tracking.rotation import relative_rotation
from geogs.tracking.turns import Turn
from geogs.types import Frame
from geogs.world.grid import SampleGrid

MAX_MISSES = 5
"""Frames that do not match the view after which the next one takes its place, without a link."""


@dataclass(frozen=True, eq=False)
class View:
    """A frame that others are matched with."""

    index: int
    image: UInt8[np.ndarray, "h w 3"]
    encoded: Any
    R: Float64[Tensor, "3 3"] | None
    """The camera that was located last to this one; none where nothing links them."""


@dataclass(frozen=True)
class Followed:
    """How a frame is turned."""

    turn: Turn
    """Against the view it was matched with."""
    R: Float64[Tensor, "3 3"] | None
    """The camera that was located last to this frame; none where nothing links them."""
    is_pure: bool
    """Whether nothing speaks for more than a rotation."""


@dataclass(frozen=True, eq=False)
class OrientationState:
    """What a checkpoint holds of an orientation chain; the fields are those of its view."""

    index: int | None
    image: UInt8[np.ndarray, "h w 3"] | None
    R: Float64[Tensor, "3 3"] | None
    flow: ChainState
    misses: int


class OrientationChain:
    """Matches each frame with one view before it, and takes another when that leaves the image.

    So the error grows with the number of views, not with that of frames.
    """

    def __init__(self, grid: SampleGrid, operator: FlowOperator, config: TrackingConfig) -> None:
        self.grid, self.operator, self.config = grid, operator, config
        self._flow = FlowChain(grid, operator, config.min_ncc)
        self._view: View | None = None
        self._misses = 0

    def state(self) -> OrientationState:
        """What a checkpoint holds."""
        v, flow = self._view, self._flow.state()
        if v is None:
            return OrientationState(None, None, None, flow, 0)
        return OrientationState(v.index, v.image, v.R, flow, self._misses)

    def load(self, state: OrientationState) -> None:
        """Go on where another was. Raises InputError if that was of another camera."""
        camera = self.grid.camera
        self._flow.load(state.flow)
        self._misses = state.misses
        if state.index is None or state.image is None:
            return
        if state.image.shape != (camera.height, camera.width, 3):
            raise InputError("the view that turns are measured against is of another camera")
        encoded = self.operator.encode(state.image)
        self._view = View(state.index, state.image, encoded, state.R)

    def located(self, frame: Frame, encoded: Any) -> None:
        """The frame has a pose: what follows may be matched with it."""
        self._take(frame, encoded, torch.eye(3, dtype=torch.float64))

    def forget(self) -> None:
        """Nothing links the next frame to those before it."""
        self._view, self._misses = None, 0
        self._flow.reset()

    def follow(self, frame: Frame, encoded: Any) -> Followed | None:
        """How the next frame is turned against the view; None if that cannot be told."""
        view = self._view
        if view is None:
            self._take(frame, encoded, None)
            return None
        match = self._flow.follow(view.encoded, encoded)
        found = None
        if match.matched >= self.config.min_matched:
            found = relative_rotation(self.grid, match.there)
        if found is None:
            self._misses += 1
            if self._misses >= MAX_MISSES:
                self._take(frame, encoded, None)
            return None
        self._misses = 0
        R = None if view.R is None else found.R @ view.R
        camera = self.grid.camera
        edge = max(camera.width, camera.height)
        if calls_for_keyframe(self.config, edge, match.flow, match.matched):
            self._take(frame, encoded, R)
        return Followed(Turn(view.index, found.R, found.deviation), R, found.is_pure)

    def _take(self, frame: Frame, encoded: Any, R: Float64[Tensor, "3 3"] | None) -> None:
        self._view, self._misses = View(frame.index, frame.image, encoded, R), 0
        self._flow.reset()
