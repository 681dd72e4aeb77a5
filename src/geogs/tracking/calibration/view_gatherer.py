"""Keyframes of an uncalibrated camera, and the flow between them."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from jaxtyping import Float
from torch import Tensor

from geogs.config import TrackingConfig
from geogs.tracking.calibration.image_motions import ImageMotions, TimedImage
from geogs.tracking.flow.filled import filled_flow, filled_positions
from geogs.tracking.flow.flow_operator import FlowOperator
from geogs.tracking.keyframes.keyframe_choice import calls_for_keyframe
from geogs.tracking.matching.flow_chain import MIN_MATCHED, MIN_TEXTURE, ChainedMotion, follow_flow
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid
from geogs.world.segments import ChainedPositions

FRAMES = 600
"""Most frames of the video that are used: bounds the time."""


@dataclass(frozen=True)
class View:
    """A keyframe without a pose."""

    frame: int
    """Number of its image in the video."""
    encoded: Any
    step: ChainedMotion | None
    """Flow between the keyframe before it and this one; None for the first."""


class ViewGatherer:
    """Selects keyframes by image motion alone, which needs no focal length."""

    def __init__(
        self, images: Iterator[TimedImage], grid: SampleGrid, operator: FlowOperator
    ) -> None:
        """``images``: of the grid's size."""
        self._images = images
        self._grid = grid
        self._operator = operator
        self._config = TrackingConfig()
        self._chain = ChainedPositions()
        self.frames = 0
        """Number of frames read so far."""
        self._is_read = False
        self.motions = ImageMotions(grid)

    @property
    def is_over(self) -> bool:
        """Whether no frame is left, or ``FRAMES`` have been read."""
        return self._is_read or self.frames >= FRAMES

    def gather(self, views: list[View], count: int, tick: Callable[[], None]) -> list[View]:
        """Extend ``views`` to ``count``, or fewer at the end of the video.

        After a sudden change of view they begin anew.
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
            self.motions.see(self.frames, following)
            if self._operator.texture(encoded) < MIN_TEXTURE:
                continue
            step = None
            if views:
                motion = follow_flow(
                    self._grid, self._operator, self._chain, views[-1].encoded, encoded
                )
                if motion.overlap < MIN_MATCHED:
                    if len(views) >= count // 2:
                        break
                    views = []
                elif not calls_for_keyframe(self._config, self._grid, motion):
                    continue
                else:
                    step = motion
            self._chain.reset()
            views.append(View(self.frames, encoded, step))
            self.motions.follow()
        return views


def flows_from_first(
    grid: SampleGrid, operator: FlowOperator, views: list[View]
) -> list[FlowMatch]:
    """Measure flow from the first view to each later one, starting from the chained steps."""
    there: Float[Tensor, "p 2"] = grid.pixels
    back = grid.pixels
    flows = []
    for view in views[1:]:
        assert view.step is not None
        there = there + grid.sample_field(filled_flow(grid, view.step.match), there)
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
