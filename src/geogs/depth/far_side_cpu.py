"""What lies beyond each pixel and what the images say of it, in compiled loops on a CPU.

The same as :func:`geogs.depth.far_side.farther_surface` and
:func:`geogs.depth.photo_vote.photo_vote`, which a GPU takes and which the loops are held to; but
the images are asked only where there is something beyond.
"""

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from geogs.depth import far_side_kernels as kernels
from geogs.depth.depth_view import DepthView
from geogs.depth.photo_vote import CONTRAST, DEVIATIONS, LEAST_DEVIATION, RADIUS
from geogs.geometry.camera import Camera
from geogs.geometry.jumps import minmod_slopes


def compiled_farther_surface(
    depth: Float32[Tensor, "h w"], reach: int, apart: float
) -> Float32[Tensor, "h w"]:
    """Depth of the nearest surface within ``reach`` pixels whose inverse depth is less by ``apart``
    of the pixel's own, its plane gone on to the pixel; 0 where there is none."""
    inverse = 1 / depth
    planes = torch.stack([inverse, *minmod_slopes(inverse, depth > 0)]).numpy()
    found = np.zeros_like(planes)
    kernels.farther_planes(planes, planes[0].min(), np.float32(1 - apart), reach, found)
    beyond = torch.from_numpy(found[0])
    return torch.where(beyond > 0, 1 / beyond.clamp(min=1e-12), 0.0)


class CompiledPhotoVote:
    """Asks the images of some neighbours about depths of a view."""

    def __init__(self, view: DepthView, neighbours: Sequence[DepthView], camera: Camera) -> None:
        """``camera`` is that of the depths and of the views' ``grey``; there are neighbours."""
        size = (camera.width, camera.height)
        colour = cv2.resize(view.image, size, interpolation=cv2.INTER_AREA)
        self._guide = colour.astype(np.float32) / np.float32(255)
        self._grey, self._images = view.grey, np.stack([v.grey for v in neighbours])
        poses = np.stack([v.T_cw for v in neighbours]) @ np.linalg.inv(view.T_cw)
        self._poses = poses[:, :3].astype(np.float32)
        self._lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)

    def __call__(
        self, depth: Float32[Tensor, "h w"], beyond: Float32[Tensor, "h w"]
    ) -> Float32[Tensor, "h w"]:
        """How much better the images agree ``beyond`` than at the depth, in [-1, 1]; 0 where there
        is nothing beyond, which is where light and noise are learned."""
        views = self._grey, self._images, self._poses, self._lens
        differences = np.empty_like(self._images)
        kernels.grey_differences(*views, depth.numpy(), differences)
        light, most = _light_and_noise(differences, (beyond == 0).numpy())
        gain, vote = np.empty_like(self._grey), np.empty_like(self._grey)
        others, other = np.empty_like(self._images), beyond.numpy()
        kernels.grey_differences(*views, other, others)
        kernels.cost_gains(differences, others, other, light, most, gain)
        kernels.average_gains(gain, other, self._guide, RADIUS, np.float32(CONTRAST), vote)
        return torch.from_numpy(vote)


def _light_and_noise(
    differences: Float32[np.ndarray, "n h w"], same: Bool[np.ndarray, "h w"]
) -> tuple[Float32[np.ndarray, "n"], Float32[np.ndarray, "n"]]:
    """Median difference of each neighbour where there is one depth, and the deviation from it that
    counts in full."""
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
