"""The frames of a video that structure from motion works on: the sharp ones, evenly spread."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

from geogs.types import Frame

SECONDS = 0.33
"""Time from which one frame is taken."""
FEWEST, MOST = 40, 250
"""Frames to take of a video whose length is known, at least and at most."""


@dataclass(frozen=True, slots=True)
class ChosenFrames:
    """The sharpest frame of each stretch of a video."""

    frames: tuple[Frame, ...]
    timestamps: Float64[np.ndarray, "n"]
    """Times of all frames of the video, seconds."""


def stretch_length(fps: float, length: int | None) -> int:
    """Frames of which one is taken."""
    every = max(1, round(SECONDS * fps))
    if length is not None:
        every = max(math.ceil(length / MOST), min(every, max(1, length // FEWEST)))
    return every


def sharpest_frames(frames: Iterable[Frame], every: int) -> ChosenFrames:
    """The frame with the strongest fine structure of each ``every`` successive ones."""
    chosen: list[Frame] = []
    times: list[float] = []
    best = -1.0
    for number, frame in enumerate(frames):
        times.append(frame.timestamp)
        if number % every == 0:
            best = -1.0
        sharp = sharpness(frame.image)
        if sharp <= best:
            continue
        if best >= 0:
            chosen.pop()
        chosen.append(frame)
        best = sharp
    return ChosenFrames(tuple(chosen), np.array(times, np.float64))


def sharpness(image: UInt8[np.ndarray, "h w 3"]) -> float:
    """Variance of the Laplacian of the grey levels."""
    return float(cv2.Laplacian(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), cv2.CV_32F).var())
