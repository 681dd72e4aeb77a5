"""Which of two depths the images of the neighbours speak for, pixel by pixel.

A window that is matched as a whole holds both surfaces at an edge, and a network guesses there. One
pixel holds one: seen from where it is, it has the same grey value in the neighbours. What single
pixels say is averaged over those around of the same colour, which are of the same surface (adaptive
support weights, Yoon and Kweon 2006).
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
"""Median deviations of a neighbour's grey values from which a difference counts in full: beyond two
standard deviations of the noise how large it is tells nothing."""
LEAST_DEVIATION = 0.5 / 255
"""Of grey values in [0, 1], which are rounded."""
RADIUS = 5
"""Pixels around that have a say."""
CONTRAST = 8 / 255
"""Mean difference of their colours by which their say falls to 1 / e."""


def photo_costs(
    view: DepthView,
    neighbours: Sequence[DepthView],
    depths: Float32[Tensor, "2 h w"],
    same: Bool[Tensor, "h w"],
    camera: Camera,
    asked: Bool[Tensor, "h w"] | None = None,
) -> Float32[Tensor, "2 h w"]:
    """How badly the neighbours' images agree at each of two depths, in [0, 1]: means over the
    pixels around that have the same colour.

    Args:
        view: the view that the depths are of.
        neighbours: what it is compared with, at least one.
        depths: two depths of each pixel, z in map units; 0 where there is none.
        same: where both are of one surface, from which the neighbours' noise and light are learned.
        camera: of the depths and of the views' ``grey``.
        asked: where that is asked: elsewhere the result is 0, and the second depth is taken for the
            first. By default everywhere.
    """
    size = (camera.width, camera.height)
    colour = cv2.resize(view.image, size, interpolation=cv2.INTER_AREA)
    guide = colour.astype(np.float32) / np.float32(255)
    where = np.ones(guide.shape[:2], bool) if asked is None else asked.numpy()
    window = np.ones((2 * RADIUS + 1, 2 * RADIUS + 1), np.uint8)
    near = cv2.dilate(where.astype(np.uint8), window).astype(bool)
    images = np.stack([v.grey for v in neighbours])
    poses = relative_poses(view, neighbours)[:, :3].astype(np.float32)
    lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
    first, second = np.ascontiguousarray(depths.numpy(), np.float32)
    differences, costs = np.empty_like(images), np.empty(depths.shape, np.float32)
    kernels.grey_differences(view.grey, images, poses, lens, first, differences)
    light, most = _light_and_noise(differences, same.numpy())
    kernels.pixel_costs(differences, light, most, near, costs[0])
    other = np.where(where, second, np.float32(0))
    kernels.grey_differences(view.grey, images, poses, lens, other, differences)
    kernels.pixel_costs(differences, light, most, where, costs[1])
    costs[1] = np.where(where, costs[1], costs[0])
    mean = np.empty_like(costs)
    kernels.average_costs(costs, where, guide, RADIUS, np.float32(CONTRAST), mean)
    return torch.from_numpy(mean)


def _light_and_noise(
    differences: Float32[np.ndarray, "n h w"], same: Bool[np.ndarray, "h w"]
) -> tuple[Float32[np.ndarray, "n"], Float32[np.ndarray, "n"]]:
    """As the tensors' of that name, only of what is known."""
    light, most = np.zeros((2, len(differences)), np.float32)
    for n, known in enumerate(differences[:, same]):
        known = known[~np.isnan(known)]
        deviation = np.float32(0)
        if len(known):
            light[n] = _lower_median(known)
            deviation = _lower_median(np.abs(known - light[n]))
        most[n] = DEVIATIONS * max(deviation, np.float32(LEAST_DEVIATION))
    return light, most


def _lower_median(values: Float32[np.ndarray, "k"]) -> np.float32:
    middle = (len(values) - 1) // 2
    return np.float32(np.partition(values, middle)[middle])
