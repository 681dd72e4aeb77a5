"""Keyframes of a camera about which nothing is known, and the flow between them."""

from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from geogs.config import TrackingConfig
from geogs.tracking.flow.filled import filled_flow, filled_positions
from geogs.tracking.flow.flow_operator import FlowOperator
from geogs.tracking.frames.row_errors import slope_at_zero
from geogs.tracking.keyframes.keyframe_choice import calls_for_keyframe
from geogs.tracking.matching.flow_chain import (
    MIN_MATCHED,
    MIN_TEXTURE,
    ChainedMatch,
    follow_flow,
)
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid
from geogs.world.segments import ChainedPositions

FRAMES = 600
"""Frames of the video that are used, at most: bounds the time."""


BESIDE, FARTHEST = 5, 0.3
"""Images that say how a view moves while it is read, with itself, and the seconds that one of them
may be away from it (docs/notebook/calibration.md)."""


class TimedImage(NamedTuple):
    """An image of a video."""

    timestamp: float
    """Seconds."""
    image: UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True)
class View:
    """A keyframe without a pose."""

    frame: int
    """Which image of the video it is."""
    encoded: Any
    step: ChainedMatch | None
    """Flow between the keyframe before it and this one; None for the first."""


class ViewGatherer:
    """Takes keyframes by image motion alone, which needs no focal length."""

    def __init__(
        self, images: Iterator[TimedImage], grid: SampleGrid, operator: FlowOperator
    ) -> None:
        """``images`` of the grid's size."""
        self._images, self._grid, self._operator = images, grid, operator
        self._config = TrackingConfig()
        self._chain = ChainedPositions()
        self.frames = 0
        """Frames taken so far."""
        self._is_read = False
        self._latest = deque[_Encoded](maxlen=BESIDE)
        self._beside = defaultdict[int, list[_Beside]](list)
        """By frame."""

    @property
    def is_over(self) -> bool:
        """Whether no frame is left, or ``FRAMES`` are enough."""
        return self._is_read or self.frames >= FRAMES

    def gather(self, views: list[View], count: int, tick: Callable[[], None]) -> list[View]:
        """``views`` grown to ``count``, or less where the video is over.

        The frames begin anew where the view changes at once, with what comes after.
        """
        views = list(views)
        while len(views) < count and not self.is_over:
            following = next(self._images, None)
            if following is None:
                self._is_read = True
                break
            self.frames += 1
            tick()
            encoded = self._operator.encode(following.image)
            self._see_beside(views, _Encoded(self.frames, following.timestamp, encoded))
            if self._operator.texture(encoded) < MIN_TEXTURE:
                continue
            step = None
            if views:
                match = follow_flow(
                    self._grid, self._operator, self._chain, views[-1].encoded, encoded
                )
                if match.matched < MIN_MATCHED:
                    if len(views) >= count // 2:
                        break
                    views = []
                elif not calls_for_keyframe(self._config, self._grid, match.seen):
                    continue
                else:
                    step = match
            self._chain.reset()
            views.append(View(self.frames, encoded, step))
            for before in list(self._latest)[:-1]:
                self._measure_beside(self._latest[-1], before)
        return views

    # --- how what is seen moves while a view is read ------------------------------------------

    def velocity(self, view: View) -> tuple[Float[Tensor, "p 2"], Bool[Tensor, "p"]]:
        """Pixels per second of what the cells of a view show, and where they are known.

        The slope of the polynomial through their places in the images beside it in the video.
        """
        beside = self._beside[view.frame]
        times = torch.tensor([[0.0, *(b.seconds for b in beside)]], dtype=torch.float64)
        flows = torch.stack([torch.zeros_like(self._grid.pixels), *(b.flow for b in beside)])
        matched = [b.is_matched for b in beside]
        known = torch.stack(matched).all(0) if matched else self._grid.pixels[:, 0] < 0
        slope = slope_at_zero(times, flows.double().flatten(1)[None].cpu())
        return slope.reshape(-1, 2).to(flows), known

    def _see_beside(self, views: list[View], latest: "_Encoded") -> None:
        """Note an image, and where the last view's cells are in it, if it comes soon after."""
        self._latest.append(latest)
        if views and 0 < latest.frame - views[-1].frame < BESIDE // 2 + 1:
            self._measure_beside(self._of(views[-1].frame), latest)

    def _of(self, frame: int) -> "_Encoded":
        return next(seen for seen in self._latest if seen.frame == frame)

    def _measure_beside(self, of: "_Encoded", other: "_Encoded") -> None:
        seconds = other.timestamp - of.timestamp
        if abs(other.frame - of.frame) > BESIDE // 2 or not 0 < abs(seconds) < FARTHEST:
            return
        match, _ = self._operator.measure([of.encoded], [other.encoded], fine=False)
        flow, is_matched = match.pixels[0] - self._grid.pixels, match.weight[0, :, 0] > 0
        self._beside[of.frame].append(_Beside(seconds, flow, is_matched))


@dataclass(frozen=True)
class _Encoded:
    """An image of the video."""

    frame: int
    timestamp: float
    encoded: Any


@dataclass(frozen=True)
class _Beside:
    """Where the cells of a view are in an image beside it."""

    seconds: float
    """After the view."""
    flow: Float[Tensor, "p 2"]
    is_matched: Bool[Tensor, "p"]


def flows_from_first(
    grid: SampleGrid, operator: FlowOperator, views: list[View]
) -> list[FlowMatch]:
    """Flow from the first view to each later one: chained over the steps and measured again."""
    there: Float[Tensor, "p 2"] = grid.pixels
    back = grid.pixels
    flows = []
    for view in views[1:]:
        assert view.step is not None
        there = there + grid.sample_field(filled_flow(grid, view.step.there), there)
        back_step = filled_positions(grid, view.step.back)
        back = back_step + grid.sample_field(back - grid.pixels, back_step)
        match, reverse = operator.measure(
            [views[0].encoded], [view.encoded], there[None], back[None], fine=True
        )
        flows.append(match)
        if float((match.weight[0, :, 0] > 0).float().mean()) < MIN_MATCHED:
            break
        there = filled_positions(grid, match)
        back = filled_positions(grid, reverse)
    return flows
