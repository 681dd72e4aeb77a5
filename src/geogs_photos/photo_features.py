"""SIFT features of photographs, in the form of COLMAP's matching."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from geogs.stopwatch import StageProgress
from geogs.threads import thread_map
from geogs.types import Frame

MAX_EDGE = 1600
"""Longest side of a picture in which features are detected, pixels; longer ones are reduced."""
MAX_FEATURES = 4096
"""Most features of a picture; those with the strongest response are kept."""
_CONTRAST = 0.02
_SIFT_RADIUS = 0.5
"""Ratio of COLMAP's scale of a feature to OpenCV's diameter."""


@dataclass(frozen=True, slots=True)
class PhotoFeatures:
    """Features of a picture, in pixels of the stored picture."""

    keypoints: Float32[np.ndarray, "n 4"]
    """Column and row (centres of pixels at integers), scale in pixels, direction in radians."""
    descriptors: UInt8[np.ndarray, "n 128"]
    """Square roots of the fractions of the gradients, times 512 (Arandjelovic & Zisserman 2012)."""

    @classmethod
    def none(cls) -> "PhotoFeatures":
        """Empty features."""
        return cls(np.zeros((0, 4), np.float32), np.zeros((0, 128), np.uint8))

    def __len__(self) -> int:
        return len(self.keypoints)

    def stretched(self, factor: float) -> "PhotoFeatures":
        """The features of a picture stretched to the right by a factor."""
        keypoints = self.keypoints.copy()
        keypoints[:, 0] = (keypoints[:, 0] + 0.5) * factor - 0.5
        return PhotoFeatures(keypoints, self.descriptors)

    def largest(self, count: int) -> UInt8[np.ndarray, "m 128"]:
        """Descriptors of the features with the largest scale."""
        order = np.argsort(-self.keypoints[:, 2], kind="stable")
        return self.descriptors[order[:count]]


def find_features(
    picture: UInt8[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"] | None = None,
    most: int = MAX_FEATURES,
) -> PhotoFeatures:
    """Find at most ``most`` features of an RGB picture, inside its mask if there is one."""
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    height, width = grey.shape
    reduction = max(1.0, max(width, height) / MAX_EDGE)
    if reduction > 1:
        size = (round(width / reduction), round(height / reduction))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    used = None
    if mask is not None:
        size = (grey.shape[1], grey.shape[0])
        used = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    # Without the precise enlargement features lie a quarter of a pixel too far right and down.
    sift = cv2.SIFT.create(nfeatures=most, contrastThreshold=_CONTRAST, enable_precise_upscale=True)
    found, raw = sift.detectAndCompute(grey, used)
    if not found:
        return PhotoFeatures.none()
    factor = np.array([width / grey.shape[1], height / grey.shape[0]])
    rows = [
        (*((np.array(p.pt) + 0.5) * factor - 0.5), _SIFT_RADIUS * p.size * factor[0], p.angle)
        for p in found
    ]
    keypoints = np.array(rows, np.float32)
    keypoints[:, 3] = np.radians(keypoints[:, 3])
    return PhotoFeatures(keypoints, _root_sift(raw))


def squared_distances(
    one: Float32[np.ndarray, "n d"], other: Float32[np.ndarray, "m d"]
) -> Float32[np.ndarray, "n m"]:
    """Squared distances of descriptors; rounding may leave them a little below zero."""
    return (one**2).sum(1)[:, None] + (other**2).sum(1) - 2 * one @ other.T


def frame_features(frames: Sequence[Frame], progress: StageProgress) -> list[PhotoFeatures]:
    """Features of frames of a video, inside their masks."""
    return thread_map(
        lambda frame: find_features(frame.image, frame.mask),
        frames,
        lambda fraction: progress("features", fraction),
    )


def _root_sift(raw: Float32[np.ndarray, "n 128"]) -> UInt8[np.ndarray, "n 128"]:
    fraction = raw / np.maximum(raw.sum(axis=1, keepdims=True), 1e-9)
    return np.round(512 * np.sqrt(fraction)).clip(0, 255).astype(np.uint8)
