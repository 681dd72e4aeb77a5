"""SIFT features of images and their matches between images with known poses."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float64, Int64

from geogs_bench.appearance.views import TrainingView, camera_centres

_MAX_AXIS_ANGLE = 60.0
# Least contrast of a feature, over all scales of an octave: half of OpenCV's, as COLMAP has it.
_CONTRAST = 0.02


@dataclass(frozen=True)
class ImageFeatures:
    """What was found in one image."""

    pixels: Float64[np.ndarray, "n 2"]
    """Column and row, centres of pixels at integers."""
    descriptors: Float[np.ndarray, "n 128"]
    """RootSIFT (Arandjelovic and Zisserman 2012): unit length, float32."""

    def __len__(self) -> int:
        return len(self.pixels)


@dataclass(frozen=True)
class FeatureMatches:
    """Features of two images that look alike and obey their epipolar geometry."""

    first: int
    second: int
    rows: Int64[np.ndarray, "m 2"]
    """Row of the feature in the first and in the second image."""


def find_features(view: TrainingView, most: int) -> ImageFeatures:
    """SIFT features (Lowe 2004) inside the mask, the ``most`` strongest."""
    # Without the precise enlargement features lie a quarter of a pixel too far right and down.
    sift = cv2.SIFT.create(nfeatures=most, contrastThreshold=_CONTRAST, enable_precise_upscale=True)
    grey = cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY)
    mask = None if view.mask is None else view.mask.astype(np.uint8) * 255
    keypoints, descriptors = sift.detectAndCompute(grey, mask)
    pixels = np.array([point.pt for point in keypoints], np.float64).reshape(-1, 2)
    if descriptors is None:
        descriptors = np.zeros((0, 128), np.float32)
    total = descriptors.sum(1, keepdims=True)
    return ImageFeatures(pixels, np.sqrt(descriptors / np.where(total > 0, total, 1)))


def neighbour_pairs(views: list[TrainingView], neighbours: int) -> list[tuple[int, int]]:
    """Each view with the nearest ones that look in a similar direction; every pair once."""
    centres = camera_centres(views)
    axes = np.stack([view.T_cw[2, :3] for view in views])
    distance = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    distance[axes @ axes.T < np.cos(np.radians(_MAX_AXIS_ANGLE))] = np.inf
    np.fill_diagonal(distance, np.inf)
    pairs = set()
    for i, row in enumerate(distance):
        near = np.argsort(row, kind="stable")[:neighbours]
        pairs |= {(min(i, int(j)), max(i, int(j))) for j in near if np.isfinite(row[j])}
    return sorted(pairs)


def match_features(
    one: ImageFeatures, other: ImageFeatures, ratio: float
) -> Int64[np.ndarray, "m 2"]:
    """Rows of features that are each other's nearest and clearly nearer than the second."""
    if min(len(one), len(other)) < 2:
        return np.zeros((0, 2), np.int64)
    likeness = torch.from_numpy(one.descriptors) @ torch.from_numpy(other.descriptors).T
    best, index = likeness.topk(2, dim=1)
    back = likeness.argmax(0)
    # Unit vectors with cosine s are sqrt(2 - 2 s) apart.
    near, second = (2 - 2 * best).clamp(min=0).unbind(1)
    rows = torch.arange(len(one))
    good = (near < ratio**2 * second) & (back[index[:, 0]] == rows)
    return torch.stack([rows[good], index[good, 0]], 1).numpy()


def epipolar_distance(
    one: TrainingView,
    other: TrainingView,
    pixels_one: Float64[np.ndarray, "n 2"],
    pixels_other: Float64[np.ndarray, "n 2"],
) -> Float64[np.ndarray, "n"]:
    """Sampson distance in pixels to the epipolar geometry of the poses.

    Hartley and Zisserman, Eq. 11.9.
    """
    T = other.T_cw @ np.linalg.inv(one.T_cw)
    x, y, z = T[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    K_one, K_other = one.camera.matrix().numpy(), other.camera.matrix().numpy()
    F = np.linalg.inv(K_other).T @ cross @ T[:3, :3] @ np.linalg.inv(K_one)
    a, b = (np.column_stack([p, np.ones(len(p))]) for p in (pixels_one, pixels_other))
    line_other, line_one = a @ F.T, b @ F
    slope = (line_other[:, :2] ** 2).sum(1) + (line_one[:, :2] ** 2).sum(1)
    return np.abs((line_other * b).sum(1)) / np.sqrt(slope.clip(1e-24))
