"""The frames of a video that structure from motion works on: sharp ones that overlap."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

from geogs.stopwatch import StageProgress, unwatched
from geogs.types import Frame

MAX_STRETCH_SECONDS = 0.33
"""Time of a video of which one frame is chosen at least."""
SPARSE_FPS = 6.0
"""Frames a second up to which all are: neighbours share little enough as it is."""
MIN_FRAMES, MAX_FRAMES = 40, 250
"""Frames that are chosen of a video whose length is known, at least and, for the time, at most."""
MAX_MOVING_FRAMES = 500
"""Frames that are chosen at most."""
MAX_SHIFT = 0.15
"""Motion in the image after which another frame is chosen, of its longer side."""
_EDGE, _CORNERS, _QUALITY, _CORNER_DISTANCE = 320, 200, 0.01, 7
"""Motion is followed at this longer side, by so many corners so far apart."""


@dataclass(frozen=True, slots=True)
class ChosenFrames:
    """The sharpest frame of each stretch of a video."""

    frames: tuple[Frame, ...]
    timestamps: Float64[np.ndarray, "n"]
    """Times of all frames of the video, seconds."""


def choose_frames(
    video: Iterable[Frame], fps: float, length: int | None, progress: StageProgress = unwatched
) -> ChosenFrames:
    """The sharpest frame of each stretch, which ends after some time, or where the image has moved.

    Args:
        video: is read twice.
        fps: its frames a second; pictures that come without times, and far apart, may have any.
        length: how many frames it has, if that is known.
        progress: called with a stage and its finished part; what it raises ends the work.
    """
    every = stretch_length(fps, length)
    times: list[float] = []
    sharp: list[float] = []
    moved: list[float] = []
    before = None
    for number, frame in enumerate(video):
        grey = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY)
        small = _reduced(grey)
        times.append(frame.timestamp)
        sharp.append(sharpness(grey))
        moved.append(0.0 if before is None else motion(before, small))
        before = small
        if length:
            progress("choosing frames", min(1.0, (number + 1) / length))
    places = set(_sharpest(sharp, moved, every))
    frames = tuple(frame for k, frame in enumerate(video) if k in places)
    return ChosenFrames(frames, np.array(times, np.float64))


def stretch_length(fps: float, length: int | None) -> int:
    """Frames of a video of which one is chosen at least."""
    every = max(1, round(MAX_STRETCH_SECONDS * fps)) if fps > SPARSE_FPS else 1
    if length is not None:
        every = max(math.ceil(length / MAX_FRAMES), min(every, max(1, length // MIN_FRAMES)))
    return every


def sharpness(grey: UInt8[np.ndarray, "h w"]) -> float:
    """Variance of the Laplacian of the grey levels."""
    return float(cv2.Laplacian(grey, cv2.CV_32F).var())


def motion(before: UInt8[np.ndarray, "h w"], after: UInt8[np.ndarray, "h w"]) -> float:
    """Median motion of the corners of an image up to the next one, of the longer side.

    Corners that are not found again count as far away: where they are most, it is 1. So it is where
    there are none; what the camera does then is not known.
    """
    corners = cv2.goodFeaturesToTrack(before, _CORNERS, _QUALITY, _CORNER_DISTANCE)
    if corners is None:
        return 1.0
    there, found = _followed(before, after, corners)
    back, returned = _followed(after, before, there)
    long_edge = max(before.shape)
    distance = np.linalg.norm((there - corners)[:, 0], axis=1) / long_edge
    missed = np.linalg.norm((back - corners)[:, 0], axis=1) > 1.0
    distance[~(found & returned) | missed] = 1.0
    return float(np.median(distance).clip(0, 1))


def _followed(
    before: UInt8[np.ndarray, "h w"],
    after: UInt8[np.ndarray, "h w"],
    corners: Float32[np.ndarray, "n 1 2"],
) -> tuple[Float32[np.ndarray, "n 1 2"], np.ndarray]:
    """Where corners are in another image, and which of them are found there."""
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, corners.copy())
    return there, found[:, 0] != 0


def _reduced(grey: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    shrink = min(1.0, _EDGE / max(grey.shape))
    size = (max(round(grey.shape[1] * shrink), 1), max(round(grey.shape[0] * shrink), 1))
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)


def _sharpest(sharp: Sequence[float], moved: Sequence[float], every: int) -> list[int]:
    """The sharpest frame of each stretch, by the motion of each frame since the one before.

    Stretches grow until there are no more than ``MAX_MOVING_FRAMES``.
    """
    longer = 1.0
    while True:
        starts = _stretches(moved, longer * MAX_SHIFT, round(longer * every))
        if len(starts) <= MAX_MOVING_FRAMES:
            break
        longer *= 1.05 * len(starts) / MAX_MOVING_FRAMES
    ends = [*starts[1:], len(sharp)]
    return [a + int(np.argmax(sharp[a:b])) for a, b in zip(starts, ends, strict=True)]


def _stretches(moved: Sequence[float], shift: float, every: int) -> list[int]:
    """Where each stretch begins."""
    starts: list[int] = []
    so_far = np.inf
    for k, step in enumerate(moved):
        so_far += step
        if so_far >= shift or k - starts[-1] >= every:
            starts.append(k)
            so_far = 0.0
    return starts
