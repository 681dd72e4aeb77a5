"""Photometric costs of two depths of each pixel in the images of the neighbours.

A window that is matched as a whole holds both surfaces at an edge, and a network guesses there. A
pixel is of one surface: at its depth it has the same grey value in the neighbours. Costs of single
pixels are averaged over like-coloured ones around, which are of the same surface (adaptive support
weights, Yoon and Kweon 2006).
"""

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from geogs.depth.depth_view import DepthView, relative_poses
from geogs.depth.revision import photo_vote_kernels as kernels
from geogs.geometry.camera import Camera

DEVIATIONS = 3.0
"""Median absolute deviations at which the difference of grey values is cut: beyond two standard
deviations of the noise its size has no meaning."""
LEAST_DEVIATION = 0.5 / 255
"""Least such deviation: that of rounding to 8 bits."""
RADIUS = 5
"""Radius in pixels over which costs are averaged."""
CONTRAST = 8 / 255
"""Mean difference of colours at which their weight falls to 1 / e."""


def photo_costs(
    view: DepthView,
    neighbours: Sequence[DepthView],
    depths: Float32[Tensor, "2 h w"],
    same: Bool[Tensor, "h w"],
    camera: Camera,
    mask: Bool[Tensor, "h w"] | None = None,
) -> Float32[Tensor, "2 h w"]:
    """Photometric costs in [0, 1] of two depths of each pixel, averaged over pixels of like colour
    around.

    Args:
        view: the view that the depths are of.
        neighbours: views that it is compared with, at least one.
        depths: two depths of each pixel, z in map units; 0 where there is none.
        same: where both are of one surface; the neighbours' offset and noise are estimated there.
        camera: camera of the depths and of the views' ``grey``.
        mask: pixels to evaluate, by default all; elsewhere the result is 0, and the second depth is
            replaced by the first.
    """
    size = (camera.width, camera.height)
    colour = cv2.resize(view.image, size, interpolation=cv2.INTER_AREA)
    guide = colour.astype(np.float32) / np.float32(255)
    where = np.ones(guide.shape[:2], bool) if mask is None else mask.numpy()
    window = np.ones((2 * RADIUS + 1, 2 * RADIUS + 1), np.uint8)
    near = cv2.dilate(where.astype(np.uint8), window).astype(bool)
    images = np.stack([v.grey for v in neighbours])
    poses = relative_poses(view, neighbours)[:, :3].astype(np.float32)
    lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
    first, second = np.ascontiguousarray(depths.numpy(), np.float32)
    differences = np.empty_like(images)
    costs = np.empty(depths.shape, np.float32)
    kernels.grey_differences(view.grey, images, poses, lens, first, differences)
    offset, limit = _offset_and_limit(differences, same.numpy())
    kernels.pixel_costs(differences, offset, limit, near, costs[0])
    other = np.where(where, second, np.float32(0))
    kernels.grey_differences(view.grey, images, poses, lens, other, differences)
    kernels.pixel_costs(differences, offset, limit, where, costs[1])
    costs[1] = np.where(where, costs[1], costs[0])
    mean = np.empty_like(costs)
    kernels.average_costs(costs, where, guide, RADIUS, np.float32(CONTRAST), mean)
    return torch.from_numpy(mean)


def _offset_and_limit(
    differences: Float32[np.ndarray, "n h w"], same: Bool[np.ndarray, "h w"]
) -> tuple[Float32[np.ndarray, "n"], Float32[np.ndarray, "n"]]:
    """As ``offset_and_limit`` of ``cuda/revision.py``."""
    offset, limit = np.zeros((2, len(differences)), np.float32)
    for n, known in enumerate(differences[:, same]):
        known = known[~np.isnan(known)]
        deviation = np.float32(0)
        if len(known):
            offset[n] = _lower_median(known)
            deviation = _lower_median(np.abs(known - offset[n]))
        limit[n] = DEVIATIONS * max(deviation, np.float32(LEAST_DEVIATION))
    return offset, limit


def _lower_median(values: Float32[np.ndarray, "k"]) -> np.float32:
    middle = (len(values) - 1) // 2
    return np.float32(np.partition(values, middle)[middle])
