"""Views for the losses between two views, and the weights of these."""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor

from geogs.config import LossConfig
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.losses.exposure import USUAL_NOISE

# A point must keep this fraction of its depth in the target's frame; nearer ones project wildly.
MIN_DEPTH_RATIO = 0.05
# Angle in degrees between the rays of two views that converts a tolerance in pixels to depth.
_PARALLAX = 10.0
_TEXTURE_SIDE = 5
"""Side in pixels of the window whose variance is a pixel's texture."""


@dataclass(frozen=True, eq=False)
class PhotoView:
    """A view for the multi-view losses: its smoothed image and its pose."""

    grey: Float[Tensor, "h w"]
    """Luma in [0, 1] at photometric size, smoothed; float32."""
    camera: Camera
    """Intrinsics at photometric size."""
    T_cw: Float[Tensor, "4 4"]
    """World to camera, float64."""
    texture: Float[Tensor, "h w"]
    """Ratio of the variance of grey values around each pixel to that of their noise; float32."""
    noise: Float[Tensor, ""]
    """Variance of the noise in the grey values."""
    colours: Float[Tensor, "3 h w"] | None = None
    """Red, green and blue in [0, 1], smoothed, if colours are compared."""

    @staticmethod
    def prepare(
        image: UInt8[np.ndarray, "ih iw 3"],
        camera: Camera,
        T_cw: Float[Tensor, "4 4"],
        blur: float = 0.7,
        device: torch.device | str = "cpu",
        with_colour: bool = False,
    ) -> "PhotoView":
        """View of an RGB image (any size) by ``camera``, whose size is the photometric size.

        ``blur`` is the standard deviation in pixels of a Gaussian that removes detail that bilinear
        interpolation would alias. The grey image is put on ``device``.
        """
        if min(camera.width, camera.height) < 16:
            raise InputError(
                f"the photometric image is {camera.width}x{camera.height} pixels: it needs at "
                "least 16 on each side; choose a larger size"
            )
        planes = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)]
        planes += [np.ascontiguousarray(image[..., k]) for k in range(3)] if with_colour else []
        size = (camera.width, camera.height)
        smooth = []
        for plane in planes:
            small = cv2.resize(plane, size, interpolation=cv2.INTER_AREA).astype(np.float32) / 255
            smooth.append(cv2.GaussianBlur(small, (0, 0), blur) if blur > 0 else small)
        return PhotoView.of(torch.from_numpy(np.stack(smooth)), camera, T_cw, device)

    @staticmethod
    def of(
        planes: Float[Tensor, "k h w"],
        camera: Camera,
        T_cw: Float[Tensor, "4 4"],
        device: torch.device | str = "cpu",
    ) -> "PhotoView":
        """The view of a grey image, perhaps followed by red, green and blue, on a CPU; it has the
        usual noise."""
        texture = _local_variance(planes[0]) / USUAL_NOISE
        planes = torch.cat([planes, texture[None]]).to(device)
        colours = planes[1:-1] if len(planes) > 2 else None
        noise = planes.new_tensor(USUAL_NOISE)
        return PhotoView(planes[0], camera, T_cw.detach().double(), planes[-1], noise, colours)

    @property
    def planes(self) -> Float[Tensor, "k h w"]:
        """The grey image, then the colours where there are any."""
        if self.colours is None:
            return self.grey[None]
        return torch.cat([self.grey[None], self.colours])

    def plane(self, k: int) -> "PhotoView":
        """The view with one of its ``planes`` in place of the grey image."""
        if k == 0:
            return self
        assert self.colours is not None, "the view has no colours"
        return replace(self, grey=self.colours[k - 1])

    def at(self, T_cw: Float[Tensor, "4 4"]) -> "PhotoView":
        """The same image with another pose."""
        return replace(self, T_cw=T_cw)

    def with_exposure(self, exposure: Float[Tensor, "3"]) -> "PhotoView":
        """The same image with its values times a gain plus an offset, and the noise variance after
        that."""
        gain, offset, noise = exposure
        colours = None if self.colours is None else gain * self.colours + offset
        texture = self.texture * (gain.square() * self.noise / noise)
        grey = gain * self.grey + offset
        return replace(self, grey=grey, texture=texture, noise=noise, colours=colours)


def _local_variance(grey: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Variance in the window around each pixel, mirrored at the border, of an image on a CPU."""
    image = grey.numpy()
    side = (_TEXTURE_SIDE, _TEXTURE_SIDE)
    mean, square = (cv2.boxFilter(each, -1, side) for each in (image, image * image))
    return torch.from_numpy(square - mean * mean).clamp(min=0)


def enlarge_depth(depth: Float[Tensor, "h w"], height: int, width: int) -> Float[Tensor, "H W"]:
    """Bilinear resize of a depth map whose zeros (or NaN) are unknown and stay unmixed.

    A pixel is known where all its source pixels are; others are 0. Centres map as in
    ``Camera.resized``.
    """
    known = (depth > 0) & torch.isfinite(depth)
    clean = torch.where(known, depth, torch.zeros_like(depth))
    both = torch.stack([clean, known.to(depth.dtype)])[None]
    big = F.interpolate(both, (height, width), mode="bilinear", align_corners=False)[0]
    return torch.where(big[1].detach() > 0.999, big[0], torch.zeros_like(big[0]))


def compared_planes(config: LossConfig) -> tuple[tuple[int, LossConfig], ...]:
    """Indices of the ``planes`` of two views that are compared, each with its weights.

    Grey alone, or L_1 and L_ssim as means over red, green and blue and L_ncc over grey.
    """
    if not config.colour:
        return ((0, config),)
    l1 = config.l1_weight / 3
    ssim_weight = config.ssim_weight / 3
    each = replace(config, l1_weight=l1, ssim_weight=ssim_weight, ncc_weight=0.0)
    grey = replace(config, l1_weight=0.0, ssim_weight=0.0)
    colours = tuple((k, each) for k in (1, 2, 3)) if max(l1, ssim_weight) > 0 else ()
    return (*colours, (0, grey)) if config.ncc_weight > 0 else colours


def occlusion_tolerance(config: LossConfig, camera: Camera) -> float:
    """Relative depth difference from which a pixel is hidden: tau, or the difference that moves a
    point by ``config.occlusion`` pixels between views 10 degrees apart.

    The occlusion test is then as sharp as depths can be: a long lens resolves finer steps.
    """
    pixels = config.occlusion
    return config.occlusion_ratio or pixels / (camera.fx * math.tan(math.radians(_PARALLAX)))
