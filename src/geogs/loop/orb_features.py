"""ORB features spread evenly over an image."""

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from geogs.world.loops import ImageFeatures

FEATURES = 800
"""Most features of a keyframe, strongest of each cell first; plain walls have a few hundred."""
FAST_THRESHOLD = 7
"""Least grey-level step of a corner: low, so that dark exposures still give features."""
ROWS, COLUMNS = 6, 8
"""Image cells over which the features are spread evenly."""
SURPLUS = 1.5
"""Ratio of detected to kept features, so that poor cells get theirs."""


def orb_features(
    image: UInt8[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"] | None = None,
    most: int = FEATURES,
) -> ImageFeatures:
    """Detect oriented FAST corners at eight scales, described by ORB; there may be none.

    Outside a ``mask`` of the size of the image nothing is detected. Thread-safe.
    """
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    orb = cv2.ORB.create(nfeatures=round(SURPLUS * most), fastThreshold=FAST_THRESHOLD)
    points = orb.detect(grey, None if mask is None else mask.astype(np.uint8))
    kept: list[cv2.KeyPoint] = []
    if points:
        pixels = np.array([p.pt for p in points], np.float32)
        strength = np.array([p.response for p in points])
        for n in _spread(pixels, strength, grey.shape)[:most]:
            points[n].class_id = len(kept)
            kept.append(points[n])
    described, descriptors = orb.compute(grey, kept)
    if descriptors is None:
        return ImageFeatures(np.zeros((0, 2), np.float32), np.zeros((0, 32), np.uint8))
    # Descriptors are returned in another order: OpenCV sorts by scale.
    back = np.argsort([p.class_id for p in described], kind="stable")
    pixels = np.array([p.pt for p in described], np.float32)
    return ImageFeatures(pixels[back], descriptors[back])


def _spread(pixels: np.ndarray, strength: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Order features: the strongest of every cell, then the second of every cell, and so on."""
    row = (pixels[:, 1] * ROWS / shape[0]).astype(int)
    cell = row * COLUMNS + (pixels[:, 0] * COLUMNS / shape[1]).astype(int)
    by_cell = np.lexsort((-strength, cell))
    sorted_cell = cell[by_cell]
    rank = np.arange(len(cell)) - np.searchsorted(sorted_cell, sorted_cell)
    return by_cell[np.lexsort((-strength[by_cell], rank))]
