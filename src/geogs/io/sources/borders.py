"""Borders that show no scene: bars, a blurred fill, a player's frame, rounded corners.

Their edge towards the scene stays at the same pixels while the scene moves. A sky, a dark corner
or a window also lies at the border, but its edge moves, or is no straight line along all of a side.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from geogs.io.sources.static_overlay import CHANGE, LEAST_IMAGES, usual_and_change
from geogs.io.sources.undistort import resized_to

_LONG_EDGE = 512
"""Longer side of the compared images: more only takes memory."""
_SECTIONS = 16
"""Parts of a line; a bar's edge is seen in nearly all of them."""
_MOST_OF_SIDE = 0.45
"""Largest bar, as a fraction of the image."""
_LEAST_EDGE = 3.0
"""Least grey levels across an edge, on average."""
_STAND_OUT = 1.8
"""Least ratio of the step across an edge to the steps beside it; a scene reached 1.3."""
_SOME_OF_LINE, _MOST_OF_LINE = 0.3, 0.85
"""Least fraction of a line with an edge, with other bars across it and without these."""
_IN_IMAGES = 0.8
"""Least fraction of images with the edge: some may be dark there, or black."""
_STILL = 4.0
"""Largest change in time of a pixel that shows no scene, in grey levels: blocks of a codec."""
_STILL_PART = 0.8
"""Least still part of a bar: a clock or a progress bar may move in it."""
_BLURRED = 0.35
"""Largest sharpness of a fill relative to that of the scene."""
_LEAST_MOVING = 0.25
"""Least fraction of the scene that changes, for the camera to move."""
_MARGIN = 2
"""Rows of the scene beside an edge that are given up: resizing and the codec mix them."""
_FAR = 3
"""Distance from an edge in rows that is far enough not to be mixed with it."""
_WEAK = 1.2
"""Least ratio, as ``_STAND_OUT``, for the second of two equal bars."""
_CORNER, _LEAST_CORNER = 0.03, 5e-5
"""Least part of a row that moves, for the row to hold the scene; least part of the image that a
corner covers."""
_RIM = 0.94
"""Squared radius of the ellipse that corners leave, relative to the largest in the image."""


@dataclass(frozen=True)
class Border:
    """Bars at the sides and pixels of corners that show no scene."""

    sides: tuple[int, int, int, int]
    """Rows above and below, columns at the left and right that show no scene."""
    corners: Bool[np.ndarray, "h w"]
    """Pixels of rounded corners, or outside of a circle, of the full image."""

    @property
    def mask(self) -> Bool[np.ndarray, "h w"]:
        """Pixels that show no scene."""
        height, width = self.corners.shape
        top, bottom, left, right = (side + _MARGIN if side else 0 for side in self.sides)
        mask = np.ones_like(self.corners)
        mask[top : height - bottom, left : width - right] = False
        return mask | self.corners

    def mask_of(self, height: int, width: int) -> Bool[np.ndarray, "h w"]:
        """The mask of images of another size."""
        mask = self.mask.astype(np.uint8)
        return cv2.resize(mask, (width, height), interpolation=cv2.INTER_NEAREST) > 0

    def sentence(self, long_edge: int) -> str:
        """The border in words, in pixels of images with such a longer side."""
        scale = long_edge / max(self.corners.shape)
        sides = zip(("above", "below", "left", "right"), self.sides, strict=True)
        bars = [f"{round(n * scale)} {name}" for name, n in sides if n]
        parts = [f"bars of {', '.join(bars)} (pixels)"] if bars else []
        parts += ["corners"] if self.corners.any() else []
        return f"{' and '.join(parts)}, {self.mask.mean():.0%} of each image, show no scene"


def find_border(images: Sequence[UInt8[np.ndarray, "h w 3"]]) -> Border | None:
    """The border of the images that shows no scene; none if there is none, or the camera rests.

    It is that of images reduced to ``_LONG_EDGE``.

    Args:
        images: upright and of one size, spread over a recording.
    """
    if len(images) < LEAST_IMAGES:
        return None
    scale = min(1.0, _LONG_EDGE / max(images[0].shape))
    height, width = (max(round(scale * side), 1) for side in images[0].shape[:2])
    stack = np.stack([resized_to((width, height), image) for image in images]).astype(np.float32)
    usual, change = usual_and_change(stack, _IN_IMAGES)
    sides = _sides(stack, change)
    top, bottom, left, right = sides
    inside = np.s_[top : height - bottom, left : width - right]
    if (change[inside] > CHANGE).mean() < _LEAST_MOVING:
        return None
    corners = np.zeros(change.shape, dtype=bool)
    corners[inside] = _corners(stack[:, *inside], usual[inside], change[inside])
    border = Border(sides, corners)
    return border if border.mask.any() else None


def _sides(
    stack: Float32[np.ndarray, "n h w 3"], change: Float32[np.ndarray, "h w"]
) -> tuple[int, int, int, int]:
    """Bars above, below, left and right, in pixels."""
    views = [_View.of(side, stack, change) for side in range(4)]
    lines = []
    bars = [0, 0, 0, 0]
    # First with the other bars across the lines, then between these.
    for least in (_SOME_OF_LINE, _MOST_OF_LINE):
        lines = [
            view.between(*(bars[2:] if side < 2 else bars[:2])) for side, view in enumerate(views)
        ]
        bars = [one.bar(least) or one.fill(least) for one in lines]
    # The second of two equal bars may be hard to see: a fill is like the scene beside it.
    for side, one in enumerate(lines):
        other = bars[side ^ 1]
        if not bars[side] and other > _FAR:
            rows = range(other - 2, other + 3)
            found = (r for r in rows if one.is_bar(r, _SOME_OF_LINE, _WEAK))
            bars[side] = next(found, 0)
    return bars[0], bars[1], bars[2], bars[3]


@dataclass(frozen=True)
class _View:
    """The images, with one of their sides at the top."""

    sharp: Float32[np.ndarray, "n h w"]
    """Detail of the images."""
    steps: Float32[np.ndarray, "n h-2 w"]
    """Largest step of a colour from row k to row k + 2."""
    change: Float32[np.ndarray, "h w"]
    """Change in time."""

    @classmethod
    def of(
        cls, side: int, stack: Float32[np.ndarray, "n h w 3"], change: Float32[np.ndarray, "h w"]
    ) -> "_View":
        """The view from above, below, left or right."""
        if side >= 2:
            stack, change = stack.swapaxes(1, 2), change.T
        if side % 2:
            stack, change = stack[:, ::-1], change[::-1]
        steps = np.abs(stack[:, 2:] - stack[:, :-2]).max(-1)
        sharp = np.stack([np.abs(cv2.Laplacian(image.mean(-1), cv2.CV_32F)) for image in stack])
        return cls(sharp, steps, change)

    def between(self, left: int, right: int) -> "_Lines":
        """The lines without columns at their left and right."""
        inner = slice(left, self.change.shape[1] - right)
        still = (self.change[:, inner] < _STILL).mean(1)
        return _Lines(_sections(self.sharp[..., inner]), _sections(self.steps[..., inner]), still)


def _sections(values: Float32[np.ndarray, "n rows w"]) -> Float32[np.ndarray, "n rows sections"]:
    """Means of ``_SECTIONS`` parts of rows."""
    return np.stack([s.mean(-1) for s in np.array_split(values, _SECTIONS, axis=2)], -1)


@dataclass(frozen=True)
class _Lines:
    """Rows from one side of the images, by sections."""

    sharp: Float32[np.ndarray, "n h sections"]
    """Detail of the images."""
    steps: Float32[np.ndarray, "n h-2 sections"]
    """Largest step of a colour from row k to row k + 2."""
    still: Float64[np.ndarray, " h"]
    """Part of a row that does not change in time."""

    def bar(self, least: float) -> int:
        """Rows of the bar of one colour at the top; ``least`` of its edge must be seen."""
        most = int(_MOST_OF_SIDE * len(self.still))
        return next((row for row in range(most, 1, -1) if self.is_bar(row, least)), 0)

    def is_bar(self, row: int, least: float, stand_out: float = _STAND_OUT) -> bool:
        """Whether an edge ends at ``row``, and the rows before it are still or blurred."""
        at = self.steps[:, row - 1]
        beside = [
            self.steps[:, max(row - 6, 0) : max(row - 3, 0)],
            self.steps[:, row + 3 : row + 6],
        ]
        beside = np.maximum(*(b.mean(1) if b.size else np.zeros_like(at) for b in beside))
        is_edge, in_images = (
            at.mean(axis) > np.maximum(stand_out * beside.mean(axis), _LEAST_EDGE)
            for axis in (0, 1)
        )
        if is_edge.mean() < least or in_images.mean() < min(least, _IN_IMAGES):
            return False
        is_still = self.still[: max(row - _FAR, 1)].mean() > _STILL_PART
        return bool(is_still) or self._is_blurred(row)

    def fill(self, least: float) -> int:
        """Rows of a blurred fill at the top. It may be like the scene beside it, so its edge is
        where all sections become sharp."""
        most = int(_MOST_OF_SIDE * len(self.still))
        found = next((row for row in range(most, 2 * _FAR, -1) if self._is_fill(row, least)), 0)
        detail = self.sharp.mean((0, 2))
        near = range(found - _FAR, found + 1)
        return max(near, key=lambda row: detail[row] - detail[row - 2]) if found else 0

    def _is_fill(self, row: int, least: float) -> bool:
        before = self.sharp[:, row - _FAR - 2 : row - 2].mean(1)
        behind = self.sharp[:, row + 2 : row + _FAR + 2].mean(1)
        is_step = before < _BLURRED * behind
        sections, images = (is_step.mean(axis) > 0.5 for axis in (0, 1))
        is_edge = sections.mean() >= least and images.mean() >= min(least, _IN_IMAGES)
        return bool(is_edge) and self._is_blurred(row)

    def _is_blurred(self, row: int) -> bool:
        """Whether the rows before ``row`` have little of the detail that those behind it have."""
        inside = slice(row + _FAR, max(len(self.still) // 2, row + 2 * _FAR))
        details = (
            np.median(self.sharp[:, rows].mean((1, 2))) for rows in (slice(row - _FAR), inside)
        )
        return row > 2 * _FAR and bool(next(details) < _BLURRED * next(details))


def _corners(
    stack: Float32[np.ndarray, "n h w 3"],
    usual: Float32[np.ndarray, "h w 3"],
    change: Float32[np.ndarray, "h w"],
) -> Bool[np.ndarray, "h w"]:
    """Pixels in all four corners that never change and end in an edge; none if one has none.

    They are what an ellipse leaves of the image, or of the rectangle that holds all that moves.
    """
    seen = [np.flatnonzero((change > _STILL).mean(axis) > _CORNER) for axis in (1, 0)]
    none = np.zeros(change.shape, dtype=bool)
    if not all(map(len, seen)):
        return none
    (top, bottom), (left, right) = ((at[0], at[-1]) for at in seen)
    height, width = change.shape
    v, u = np.mgrid[:height, :width]
    x, y = (u - left + 0.5) / (right - left + 1), (v - top + 0.5) / (bottom - top + 1)
    bare = (change < _STILL) & ((2 * x - 1) ** 2 + (2 * y - 1) ** 2 > _RIM)
    found = none.copy()
    for at in product((top, bottom), (left, right)):
        alike = bare & (np.abs(usual - usual[at]).max(-1) < 2 * _STILL)
        _, part = cv2.connectedComponents(alike.astype(np.uint8))
        here = part == part[at]
        if not alike[at] or here.mean() < _LEAST_CORNER:
            return none
        found |= here
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _MARGIN + 1, 2 * _MARGIN + 1))
    grown = cv2.dilate(found.astype(np.uint8), disk)
    ring = cv2.dilate(grown, disk) > grown
    steps = np.abs(stack[:, ring] - np.median(stack[:, found], axis=(0, 1))).max(-1)
    return grown > 0 if ring.any() and (steps > CHANGE).mean() > 0.5 else none
