"""The frames of a video that structure from motion works on: the sharp ones, evenly spread."""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

from geogs.types import Frame


@dataclass(frozen=True, slots=True)
class ChosenFrames:
    """The sharpest frame of each stretch of a video."""

    frames: tuple[Frame, ...]
    timestamps: Float64[np.ndarray, "n"]
    """Times of all frames of the video, seconds."""


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
