"""Points followed through a few neighbouring images, as rays with the time of their row."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from geogs.shutter.neighbours import Image
from geogs.shutter.rolling_camera import RollingCamera
from geogs.shutter.tracks import followed_points

MOST_POINTS = 160
LEAST_POINTS = 30
LEAST_IMAGES = 8
"""That a point is followed through."""


@dataclass(frozen=True)
class ClipTracks:
    """Where points are seen in the images of a clip, and when."""

    plane: Float[np.ndarray, "k n 2"]
    """x/z and y/z; 0 where a point is not seen."""
    line_times: Float[np.ndarray, "k n"]
    """Readouts from the middle row of the image to that of the point; 0 likewise."""
    seen: Bool[np.ndarray, "k n"]
    """Every point in the middle image."""
    times: Float[np.ndarray, "k"]
    """Seconds of the middle rows, from that of the middle image."""

    @property
    def middle(self) -> int:
        """Position of the image that all points are seen in."""
        return len(self.times) // 2


def clip_tracks(clip: Sequence[Image], camera: RollingCamera) -> ClipTracks | None:
    """Corners of the middle image, those that are seen longest; none where they are too few.

    Args:
        clip: neighbours in a video, all of which could be read.
        camera: that took them.
    """
    images = [cv2.cvtColor(i.image, cv2.COLOR_RGB2GRAY) for i in clip if i.image is not None]
    if len(images) < len(clip):
        return None
    pixels = followed_points(images)
    count = np.isfinite(pixels[..., 0]).sum(axis=0)
    longest = np.sort(np.argsort(-count, kind="stable")[:MOST_POINTS])
    pixels = pixels[:, longest[count[longest] >= LEAST_IMAGES]]
    if pixels.shape[1] < LEAST_POINTS:
        return None
    seen = np.isfinite(pixels[..., 0])
    plane, line_times = np.zeros_like(pixels), np.zeros(seen.shape)
    rays = camera.rays(pixels[seen])
    plane[seen], line_times[seen] = rays[:, :2] / rays[:, 2:], camera.line_times(pixels[seen])
    times = np.array([image.timestamp for image in clip])
    return ClipTracks(plane, line_times, seen, times - times[len(times) // 2])
