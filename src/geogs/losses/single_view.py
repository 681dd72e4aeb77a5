"""Constants of a keyframe for the losses on one rendered view."""

import functools
from dataclasses import dataclass

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from geogs.geometry.camera import Camera

# Added to the squared length of a blended normal (about 1): bounds the slope of normalising it.
NORMAL_EPSILON = 1e-6
MIN_ALPHA = 0.5
"""Depth and normals count where alpha exceeds this: most of the light ends at the surface."""
SMOOTHNESS_ETA = 10.0
"""Decay of smoothness with the image gradient (image in [0, 1]); the paper's eta."""
OUTSIDE = -1.0
"""Prior depth of pixels that a mask excludes from the scene."""
ONE_SURFACE = 0.08
"""Largest relative difference of inverse depth within a pixel of half the resolution that has one
depth."""


@dataclass(frozen=True, eq=False)
class ViewConstants:
    """A keyframe's constants for the single-view losses, at render size."""

    camera: Camera
    """Intrinsics at render size."""
    edge: Float[Tensor, "h w"]
    """Image gradient normalised to [0, 1], see :func:`edge_strength`."""
    image_gradient: Float[Tensor, "h w"]
    """Image gradient in grey values per pixel, see :func:`gradient_norm`."""
    prior_depth: Float[Tensor, "h w"]
    """The keyframe's own depth D_f in map units; 0 where unknown, ``OUTSIDE`` beyond a mask
    and in the sky."""
    confidence: Float[Tensor, "h w"]
    """Weight of the prior depth, in [0, 1] unless it was measured."""
    prior_normal: Float[Tensor, "h w 3"] | None = None
    """Unit normals N_f in the camera frame, facing the camera; zero where unknown."""

    @staticmethod
    def prepare(
        image: UInt8[np.ndarray, "ih iw 3"],
        camera: Camera,
        prior_depth: Float[Tensor, "h w"],
        confidence: Float[Tensor, "h w"],
        prior_normal: Float[Tensor, "h w 3"] | None = None,
    ) -> "ViewConstants":
        """Constants of a keyframe with this RGB image (any size) rendered by ``camera``.

        On the prior depth's device.
        """
        size = (camera.width, camera.height)
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        rgb = torch.from_numpy(small).to(prior_depth.device).float() / 255
        edge = edge_strength(rgb)
        gradient = gradient_norm(rgb)
        normal = None if prior_normal is None else prior_normal.float()
        return ViewConstants(
            camera, edge, gradient, prior_depth.float(), confidence.float(), normal
        )

    @functools.cached_property
    def halved(self) -> "ViewConstants":
        """The constants for maps of half the resolution.

        A pixel's depth, confidence and normal are means of those in it, and unknown where some are
        unknown or of another surface; it is ``OUTSIDE`` where most of it is.
        """
        camera = self.camera.resized(self.camera.width // 2, self.camera.height // 2)
        size = (camera.height, camera.width)
        known = self.prior_depth > 0
        outside = self.prior_depth < 0
        inverse = torch.where(known, 1 / self.prior_depth.clamp(min=1e-9), 0.0)
        weight = torch.where(known, self.confidence, 0.0)
        maps = torch.stack(
            [self.edge, self.image_gradient, inverse, weight, known.float(), outside.float()]
        )
        edge, gradient, inverse_mean, mean_weight, known_fraction, beyond = F.adaptive_avg_pool2d(
            maps, size
        )
        most, least = F.adaptive_max_pool2d(torch.stack([inverse, -inverse]), size)
        one = (known_fraction > 0.999) & (most + least < ONE_SURFACE * inverse_mean)
        depth = torch.where(one, 1 / inverse_mean.clamp(min=1e-9), 0.0)
        normal = None
        if self.prior_normal is not None:
            mean = F.adaptive_avg_pool2d(self.prior_normal.movedim(-1, 0), size).movedim(0, -1)
            length = mean.norm(dim=-1, keepdim=True)
            normal = torch.where(length > 0.5, mean / length.clamp(min=1e-6), 0.0)
        depth = torch.where(beyond > 0.5, OUTSIDE, depth)
        confidence = torch.where(one, mean_weight, 0.0)
        return ViewConstants(camera, edge, gradient, depth, confidence, normal)


def edge_strength(image: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w"]:
    """The paper's |grad I| "normalised to the range of 0 to 1"; 1 on the border ring.

    Central differences, mean over colours, the larger of the two directions, min-max normalised
    over the image (PGSR). A constant image has no edges: 0 inside.
    """
    horizontal = (image[1:-1, 2:] - image[1:-1, :-2]).abs().mean(-1)
    vertical = (image[2:, 1:-1] - image[:-2, 1:-1]).abs().mean(-1)
    g = torch.maximum(horizontal, vertical)
    low, high = g.aminmax()
    return F.pad((g - low) / (high - low).clamp(min=1e-6), (1, 1, 1, 1), value=1.0)


def gradient_norm(image: Float[Tensor, "h w *c"]) -> Float[Tensor, "h w"]:
    """1-norm of the forward differences per pixel, mean over channels; 0 in the last row, column.

    For an image in grey values per pixel, for a depth map in its unit per pixel.
    """
    channels = image if image.ndim == 3 else image[..., None]
    horizontal = (channels[:-1, 1:] - channels[:-1, :-1]).abs()
    vertical = (channels[1:, :-1] - channels[:-1, :-1]).abs()
    return F.pad((horizontal + vertical).mean(-1), (0, 1, 0, 1))


def visible(depth: Float[Tensor, "h w"], alpha: Float[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """The valid pixels Omega: a finite positive depth seen with more than ``MIN_ALPHA``."""
    return (alpha > MIN_ALPHA) & (depth > 0) & torch.isfinite(depth)
