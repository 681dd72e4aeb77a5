"""Which frames become keyframes."""

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import UInt8

from geogs.concurrent import BackgroundTask
from geogs.config import TrackingConfig
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid

MIN_FLOW = 0.2
"""Fraction of the motion that makes a keyframe below which a lost overlap is none: the camera has
hardly moved, so it is the image that is poor."""
WITH_ROTATION = 1.4
"""Motion that makes a keyframe before depths are known, in multiples of the parallax that does
later: part of it is the rotation's."""
MAX_FLOW = 0.15
"""Motion that makes a keyframe without any parallax, of the long edge: over larger ones flow finds
fewer matches, and worse ones."""
LATEST, END_FRACTION = 5, 1 / 3
"""Where fewer frames are left than lie between two of so many latest keyframes, this fraction of
the usual parallax makes one: what comes into view there is seen by no later keyframe, and one alone
gives no depth."""
BLUR_RATIO = 0.7
"""A frame with less than this fraction of the latest frames' sharpness is blurred ..."""
BLUR_WAIT = 0.4
"""... and becomes a keyframe only when it has moved by this much more: a sharper one may come."""
_COMPARED = 12
"""Latest frames among which one is sharp or blurred."""
_EDGE = 320
"""Longer side of the image in which sharpness is measured; below it, noise counts for less."""


@dataclass(frozen=True)
class SeenMotion:
    """How a frame has moved since the last keyframe."""

    flow: float
    """Median motion of the cells that are matched, pixels."""
    overlap: float
    """Fraction of the keyframe's cells that are. In forward motion the cells that move most leave
    the image or are not matched any more, so that the median motion of the rest stays small while
    the overlap goes."""
    match: FlowMatch
    """One edge, keyframe -> frame."""
    parallax: float | None = None
    """Median of the motion without the rotation's, where it is known, pixels."""


def mean_flow(grid: SampleGrid, match: FlowMatch) -> float:
    """Mean motion in pixels of the cells that are matched in the first edge, 0 without any.

    Source: DROID-SLAM's motion filter, which asks all cells as its network says a motion of each.
    """
    used = match.weight[0, :, 0] > 0
    motion = (match.pixels[0] - grid.pixels).norm(dim=-1)
    return float((motion * used).sum() / used.sum().clamp(min=1))


def calls_for_keyframe(
    config: TrackingConfig,
    grid: SampleGrid,
    seen: SeenMotion,
    patience: float = 0.0,
    part: float = 1.0,
) -> bool:
    """Whether a frame is far enough from the last keyframe to become one.

    A keyframe brings depth by its parallax; one of a camera that has only turned brings none, and
    is needed where the view goes out of sight. So the parallax decides, or the overlap. Before
    depths are known, the rotation is not told from the motion, and all of it counts.

    Args:
        config: ``keyframe_parallax`` and ``keyframe_overlap``; or ``keyframe_mean_flow``, which
            decides alone where it is given.
        grid: of the keyframe.
        seen: the motion.
        patience: it may come so much further.
        part: of the usual parallax that is enough.
    """
    more, long_edge = 1 + patience, grid.camera.long_edge
    if config.keyframe_mean_flow > 0:
        return mean_flow(grid, seen.match) >= config.keyframe_mean_flow * more * long_edge
    enough = config.keyframe_parallax * more * long_edge
    if seen.overlap < config.keyframe_overlap / more and seen.flow >= MIN_FLOW * enough:
        return True
    if seen.parallax is None:
        return seen.flow >= WITH_ROTATION * part * enough
    return seen.parallax >= part * enough or seen.flow >= MAX_FLOW * more * long_edge


def is_near_end(left: int | None, latest: Iterable[int]) -> bool:
    """Whether too few frames are ``left``, as far as that is known, for another keyframe.

    ``latest`` are the numbers of the frames that became the latest keyframes.
    """
    if left is None:
        return False
    return left < max((b - a for a, b in itertools.pairwise(latest)), default=0)


def sharpness(image: UInt8[np.ndarray, "h w 3"]) -> float:
    """Energy of an image's gradients in the direction that has least, over the image's variance.

    Blur by motion takes from the gradients along the motion, hardly from the variance. The number
    says little by itself, for it follows what is seen; among neighbours in a video it tells
    which are blurred.
    """
    height, width = image.shape[:2]
    shrink = min(1.0, _EDGE / max(height, width))
    size = (max(round(width * shrink), 1), max(round(height * shrink), 1))
    grey = cv2.resize(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)
    grey = grey.astype(np.float32)
    x, y = cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)
    xx, yy, xy = float((x * x).mean()), float((y * y).mean()), float((x * y).mean())
    least = (xx + yy) / 2 - math.hypot((xx - yy) / 2, xy)  # eigenvalue of the mean outer product
    return least / float(grey.var() + 1.0)


class KeyframeChoice:
    """Says which frames become keyframes, from their parallax, overlap and sharpness."""

    def __init__(
        self, config: TrackingConfig, grid: SampleGrid, recent: list[float] | None = None
    ) -> None:
        """``recent`` is the sharpness of the latest frames, and is changed in place."""
        self.config = config
        self.grid = grid
        self._recent = [] if recent is None else recent
        self._concurrent = BackgroundTask("sharpness")

    def see(self, image: UInt8[np.ndarray, "h w 3"]) -> None:
        """Take note of the next frame, about which :meth:`calls_for` is asked.

        Its sharpness is measured while it is tracked.
        """
        self._concurrent.start(lambda: self._note(sharpness(image)))

    def settle(self) -> None:
        """Wait until the latest frame has been noted."""
        self._concurrent.wait()

    def calls_for(self, seen: SeenMotion, near: bool = False) -> bool:
        """Whether the frame seen last becomes one: see :func:`calls_for_keyframe`.

        A frame that is blurred compared with the latest ones waits for a sharper one, though not
        for long: nothing else sees what comes into view meanwhile. ``near`` says that
        :func:`is_near_end`. Where the mean flow decides, neither counts.
        """
        if self.config.keyframe_mean_flow > 0:
            return calls_for_keyframe(self.config, self.grid, seen)
        patience, part = BLUR_WAIT if self._is_blurred() else 0.0, END_FRACTION if near else 1.0
        return calls_for_keyframe(self.config, self.grid, seen, patience, part)

    def _note(self, value: float) -> None:
        self._recent.append(value)
        del self._recent[:-_COMPARED]

    def _is_blurred(self) -> bool:
        self.settle()
        if len(self._recent) < 3:
            return False
        return self._recent[-1] < BLUR_RATIO * float(np.median(self._recent))
