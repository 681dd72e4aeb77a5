"""Keyframe selection."""

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
"""Fraction of a keyframe's motion below which a lost overlap is ignored: the camera has hardly
moved, so the image is poor."""
WITH_ROTATION = 1.4
"""Motion for a keyframe before depths are known, in multiples of the parallax needed later: a part
of it is rotation."""
MAX_FLOW = 0.15
"""Motion for a keyframe without any parallax, as a fraction of the long edge: for larger motions
flow finds fewer and worse matches."""
LATEST, END_FRACTION = 5, 1 / 3
"""Number of latest keyframes, and fraction of the usual parallax that is enough if fewer frames are
left than between two of these: what comes into view there is not seen by later keyframes, and a
single one gives no depth."""
BLUR_RATIO = 0.7
"""Ratio to the latest frames' sharpness below which a frame is blurred."""
BLUR_WAIT = 0.4
"""Relative additional motion before a blurred frame becomes a keyframe: a sharper one may come."""
_COMPARED = 12
"""Number of latest frames whose sharpness is compared."""
_EDGE = 320
"""Longer side, in pixels, of the image for sharpness; reduction lowers the noise."""


@dataclass(frozen=True)
class SeenMotion:
    """Motion of a frame since the last keyframe."""

    flow: float
    """Median motion of the matched cells, pixels."""
    overlap: float
    """Fraction of the keyframe's cells that are matched. In forward motion the fastest cells leave
    the image or lose their match, so the median motion of the rest stays small while the overlap
    falls."""
    match: FlowMatch
    """One edge, keyframe -> frame."""
    parallax: float | None = None
    """Median motion without that of the rotation, pixels; None where unknown."""


def mean_flow(grid: SampleGrid, match: FlowMatch) -> float:
    """Return the mean motion in pixels of the matched cells of the first edge, 0 without any.

    Source: DROID-SLAM's motion filter, which uses all cells, as its network gives a motion of each.
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

    A keyframe gives depth by its parallax; after a pure rotation it gives none, and is only needed
    where the view leaves the image. So parallax or overlap decide. Before depths are known,
    rotation cannot be separated from translation, and all motion counts.

    Args:
        config: ``keyframe_parallax`` and ``keyframe_overlap``; or ``keyframe_mean_flow``, which
            decides alone where it is given.
        grid: of the keyframe.
        seen: the motion.
        patience: relative increase of the thresholds.
        part: fraction of the usual parallax that is enough.
    """
    more = 1 + patience
    long_edge = grid.camera.long_edge
    if config.keyframe_mean_flow > 0:
        return mean_flow(grid, seen.match) >= config.keyframe_mean_flow * more * long_edge
    enough = config.keyframe_parallax * more * long_edge
    if seen.overlap < config.keyframe_overlap / more and seen.flow >= MIN_FLOW * enough:
        return True
    if seen.parallax is None:
        return seen.flow >= WITH_ROTATION * part * enough
    return seen.parallax >= part * enough or seen.flow >= MAX_FLOW * more * long_edge


def is_near_end(left: int | None, latest: Iterable[int]) -> bool:
    """Whether too few frames are ``left`` for another keyframe; False if that is unknown.

    ``latest`` are the numbers of the frames that became the latest keyframes.
    """
    if left is None:
        return False
    return left < max((b - a for a, b in itertools.pairwise(latest)), default=0)


def sharpness(image: UInt8[np.ndarray, "h w 3"]) -> float:
    """Return the gradient energy of an image in its weakest direction, over the image's variance.

    Motion blur reduces gradients along the motion, but hardly the variance. The value depends on
    the content, so only a comparison among neighbours in a video shows which are blurred.
    """
    height, width = image.shape[:2]
    shrink = min(1.0, _EDGE / max(height, width))
    size = (max(round(width * shrink), 1), max(round(height * shrink), 1))
    grey = cv2.resize(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)
    grey = grey.astype(np.float32)
    x = cv2.Sobel(grey, cv2.CV_32F, 1, 0)
    y = cv2.Sobel(grey, cv2.CV_32F, 0, 1)
    xx = float((x * x).mean())
    yy = float((y * y).mean())
    xy = float((x * y).mean())
    least = (xx + yy) / 2 - math.hypot((xx - yy) / 2, xy)  # eigenvalue of the mean outer product
    return least / float(grey.var() + 1.0)


class KeyframeChoice:
    """Selects keyframes by parallax, overlap and sharpness."""

    def __init__(
        self, config: TrackingConfig, grid: SampleGrid, recent: list[float] | None = None
    ) -> None:
        """``recent``: sharpness of the latest frames, changed in place."""
        self.config = config
        self.grid = grid
        self._recent = [] if recent is None else recent
        self._concurrent = BackgroundTask("sharpness")

    def see(self, image: UInt8[np.ndarray, "h w 3"]) -> None:
        """Register the next frame for :meth:`calls_for`; its sharpness is measured in the
        background."""
        self._concurrent.start(lambda: self._note(sharpness(image)))

    def settle(self) -> None:
        """Wait for the sharpness of the latest frame."""
        self._concurrent.wait()

    def calls_for(self, seen: SeenMotion, near: bool = False) -> bool:
        """Whether the frame seen last becomes one: see :func:`calls_for_keyframe`.

        A blurred frame waits for a sharper one, but not for long: no other keyframe sees what comes
        into view meanwhile. ``near``: result of :func:`is_near_end`. Where the mean flow decides,
        neither counts.
        """
        if self.config.keyframe_mean_flow > 0:
            return calls_for_keyframe(self.config, self.grid, seen)
        self.settle()
        recent = self._recent
        is_blurred = len(recent) >= 3 and recent[-1] < BLUR_RATIO * float(np.median(recent))
        patience = BLUR_WAIT if is_blurred else 0.0
        part = END_FRACTION if near else 1.0
        return calls_for_keyframe(self.config, self.grid, seen, patience, part)

    def _note(self, value: float) -> None:
        self._recent.append(value)
        del self._recent[:-_COMPARED]
