"""Frame selection for structure from motion of a video: sharp frames that overlap."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

from geogs.stopwatch import StageProgress, unwatched
from geogs.types import Frame

MAX_STRETCH_SECONDS = 0.33
"""Longest time without a selected frame."""
SPARSE_FPS = 6.0
"""Frame rate up to which all frames are selected: neighbours overlap little already."""
MIN_FRAMES, MAX_FRAMES = 40, 250
"""Least number of frames selected from a video of known length, and largest by time alone."""
MAX_MOVING_FRAMES = 500
"""Largest number of selected frames."""
MAX_SHIFT = 0.15
"""Image motion after which another frame is selected, relative to the longer side."""
_EDGE, _CORNERS, _QUALITY, _CORNER_DISTANCE = 320, 200, 0.01, 7
"""Longer image side for motion tracking, and number, quality and distance of corners."""


@dataclass(frozen=True, slots=True)
class ChosenFrames:
    """The sharpest frame of each stretch of a video."""

    frames: tuple[Frame, ...]
    timestamps: Float64[np.ndarray, "n"]
    """Times of all frames of the video, seconds."""


def choose_frames(
    video: Iterable[Frame], fps: float, length: int | None, progress: StageProgress = unwatched
) -> ChosenFrames:
    """Select the sharpest frame of each stretch, which ends after some time or image motion.

    Args:
        video: the video, which is read twice.
        fps: its frame rate; arbitrary for single pictures without times.
        length: number of its frames, if known.
        progress: called with a stage and its finished fraction; an exception ends the work.
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
    """Length of a stretch, from which at least one frame is selected, in frames."""
    every = max(1, round(MAX_STRETCH_SECONDS * fps)) if fps > SPARSE_FPS else 1
    if length is not None:
        every = max(math.ceil(length / MAX_FRAMES), min(every, max(1, length // MIN_FRAMES)))
    return every


def sharpness(grey: UInt8[np.ndarray, "h w"]) -> float:
    """Variance of the Laplacian of the grey levels."""
    return float(cv2.Laplacian(grey, cv2.CV_32F).var())


def motion(before: UInt8[np.ndarray, "h w"], after: UInt8[np.ndarray, "h w"]) -> float:
    """Median motion of corners from an image to the next, relative to the longer side.

    Lost corners count as a motion of 1, so it is 1 if most are lost. It is also 1 without any
    corners, as the motion is unknown then.
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
    """Track corners to another image: positions, and which of them were found."""
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
    """Index of the first frame of each stretch."""
    starts: list[int] = []
    so_far = np.inf
    for k, step in enumerate(moved):
        so_far += step
        if so_far >= shift or k - starts[-1] >= every:
            starts.append(k)
            so_far = 0.0
    return starts
