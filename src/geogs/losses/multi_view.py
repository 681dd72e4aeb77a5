"""Losses between two views: the target image seen through the reference's rendered depth."""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from geogs.config import LossConfig
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_inverse
from geogs.losses.photometric import MIN_COVERAGE, NCC_MIN_VARIANCE, ncc, robust_l1, ssim

# A point must keep this fraction of its depth in the target's frame; nearer ones project wildly.
MIN_DEPTH_RATIO = 0.05
# Degrees between the rays of two views at which the occlusion test is told in pixels.
_PARALLAX = 10.0


@dataclass(frozen=True, eq=False)
class PhotoView:
    """What the multi-view losses know of a view: its smoothed image and where it was taken."""

    grey: Float[Tensor, "h w"]
    """Luma in [0, 1] at photometric size, smoothed; float32."""
    camera: Camera
    """Intrinsics at photometric size."""
    T_cw: Float[Tensor, "4 4"]
    """World to camera, float64."""
    colours: Float[Tensor, "3 h w"] | None = None
    """Red, green and blue in [0, 1], smoothed; where they are compared."""

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

        ``blur`` is the standard deviation in pixels of a Gaussian that takes out what bilinear
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
        return PhotoView.of(torch.from_numpy(np.stack(smooth)).to(device), camera, T_cw)

    @staticmethod
    def of(
        planes: Float[Tensor, "k h w"], camera: Camera, T_cw: Float[Tensor, "4 4"]
    ) -> "PhotoView":
        """The view of a grey image, followed by red, green and blue or by nothing."""
        colours = planes[1:] if len(planes) > 1 else None
        return PhotoView(planes[0], camera, T_cw.detach().double(), colours)

    @property
    def planes(self) -> Float[Tensor, "k h w"]:
        """The grey image, then the colours where there are any."""
        if self.colours is None:
            return self.grey[None]
        return torch.cat([self.grey[None], self.colours])

    def plane(self, k: int) -> "PhotoView":
        """The view with one of its ``planes`` for the grey image."""
        if k == 0:
            return self
        assert self.colours is not None, "the view has no colours"
        return replace(self, grey=self.colours[k - 1])

    def at(self, T_cw: Float[Tensor, "4 4"]) -> "PhotoView":
        """The same image with another pose."""
        return replace(self, T_cw=T_cw)


@dataclass(frozen=True, eq=False)
class Warped:
    """A target image brought into the reference view."""

    image: Float[Tensor, "h w *c"]
    """I_r->t; 0 where out of view."""
    pixels: Float[Tensor, "h w 2"]
    """Where each reference pixel falls in the target, p_t."""
    depth: Float[Tensor, "h w"]
    """z in the target's frame, map units."""
    in_view: Bool[Tensor, "h w"]
    """M_view: depth known, in front of the target, inside its image."""


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


def bilinear(image: Float[Tensor, "h w *c"], pixels: Float[Tensor, "*b 2"]) -> Float[Tensor, "..."]:
    """Bilinear samples of an image at pixel coordinates inside it, ``(*b, *c)``.

    Paper Eq. bilinear_interpolation; its slope jumps where it crosses a pixel.
    """
    height, width = image.shape[:2]
    x, y = pixels.unbind(-1)
    left = x.detach().floor().clamp(0, width - 2)
    top = y.detach().floor().clamp(0, height - 2)
    fx, fy = x - left, y - top
    if image.ndim == 3:
        fx, fy = fx[..., None], fy[..., None]
    i, j = left.long(), top.long()
    upper = image[j, i] * (1 - fx) + image[j, i + 1] * fx
    lower = image[j + 1, i] * (1 - fx) + image[j + 1, i + 1] * fx
    return upper * (1 - fy) + lower * fy


def warp(
    target_image: Float[Tensor, "th tw *c"],
    depth: Float[Tensor, "h w"],
    reference_camera: Camera,
    target_camera: Camera,
    reference_T_cw: Float[Tensor, "4 4"],
    target_T_cw: Float[Tensor, "4 4"],
) -> Warped:
    """The target image at the points of the reference's depth: paper Eqs. back_project, bilinear.

    Depth is in map units at the reference image's size (0 where unknown). Differentiable in the
    depth and both poses.
    """
    T = (target_T_cw @ se3_inverse(reference_T_cw)).to(depth.dtype)
    points = reference_camera.back_project(depth) @ T[:3, :3].mT + T[:3, 3]
    front = (depth > 0) & (points[..., 2] > MIN_DEPTH_RATIO * depth)
    points = torch.where(front[..., None], points, torch.ones_like(points))
    pixels, z = target_camera.project(points)
    edge = pixels.new_tensor([target_camera.width - 1, target_camera.height - 1])
    in_view = front & (pixels >= 0).all(-1) & (pixels <= edge).all(-1)
    inside = torch.where(in_view[..., None], pixels, torch.zeros_like(pixels))
    image = bilinear(target_image, inside)
    mask = in_view if image.ndim == 2 else in_view[..., None]
    image = torch.where(mask, image, torch.zeros_like(image))
    return Warped(image, pixels, z, in_view)


def occlusion_mask(
    warped: Warped,
    target_depth: Float[Tensor, "dh dw"],
    target_camera: Camera,
    tolerance: float = 0.05,
) -> Bool[Tensor, "h w"]:
    """M = M_view M_occ: paper Eqs. occlusion_mask, valid_mask.

    Visible where the relative difference between the point's depth and the target's rendered depth
    is below ``tolerance``. That depth may have another size than the target image; it is sampled
    bilinearly, and its pixels without depth (0) see nothing.
    """
    height, width = target_depth.shape
    small = target_camera.resized(width, height)
    image = warped.pixels.detach()
    x = (image[..., 0] - target_camera.cx) * (small.fx / target_camera.fx) + small.cx
    y = (image[..., 1] - target_camera.cy) * (small.fy / target_camera.fy) + small.cy
    zero = torch.zeros_like(x)
    x = torch.where(warped.in_view, x.clamp(0, width - 1), zero)
    y = torch.where(warped.in_view, y.clamp(0, height - 1), zero)
    known = (target_depth > 0) & torch.isfinite(target_depth)
    clean = torch.where(known, target_depth, torch.zeros_like(target_depth)).detach().to(x.dtype)
    maps = torch.stack([clean, known.to(x.dtype)], -1)
    seen, coverage = bilinear(maps, torch.stack([x, y], -1)).unbind(-1)
    z = warped.depth.detach()
    return warped.in_view & (coverage > 0.999) & ((z - seen).abs() < tolerance * z)


def compared_planes(config: LossConfig) -> tuple[tuple[int, LossConfig], ...]:
    """Which of the ``planes`` of two views are compared, each with the weights it has.

    Grey alone, or L_1 and L_ssim as means over red, green and blue and L_ncc over grey.
    """
    if not config.colour:
        return ((0, config),)
    l1, ssim_weight = config.l1_weight / 3, config.ssim_weight / 3
    each = replace(config, l1_weight=l1, ssim_weight=ssim_weight, ncc_weight=0.0)
    grey = replace(config, l1_weight=0.0, ssim_weight=0.0)
    colours = tuple((k, each) for k in (1, 2, 3)) if max(l1, ssim_weight) > 0 else ()
    return (*colours, (0, grey)) if config.ncc_weight > 0 else colours


def occlusion_tolerance(config: LossConfig, camera: Camera) -> float:
    """Relative depth difference from which a pixel is hidden: tau, or what moves a point by so many
    pixels between views 10 degrees apart.

    So the occlusion test is as sharp as depths can be: a camera with a long lens sees finer steps.
    """
    pixels = config.occlusion
    return config.occlusion_ratio or pixels / (camera.fx * math.tan(math.radians(_PARALLAX)))


def multi_view_loss(
    depth: Float[Tensor, "h w"],
    reference: PhotoView,
    target: PhotoView,
    target_depth: Float[Tensor, "dh dw"] | None,
    config: LossConfig,
) -> Float[Tensor, ""]:
    """Photometric difference of two views through a rendered depth: paper Eq. multiview_loss.

    ``depth`` is the reference's at render size, 0 where alpha is low; it is enlarged to the
    photometric size. Without ``target_depth`` (the target's rendered depth, any size, no gradient)
    nothing counts as hidden. Each term is summed over valid pixels and divided by the number of
    all pixels. Differentiable in the depth and in both views' ``T_cw``. Any dtype and device;
    :func:`geogs.losses.cpu.fused_multi_view` is the same on a CPU, faster.
    """
    loss = depth.new_zeros(())
    for k, weights in compared_planes(config):
        loss = loss + _plane_loss(depth, reference.plane(k), target.plane(k), target_depth, weights)
    return loss


def _plane_loss(
    depth: Float[Tensor, "h w"],
    reference: PhotoView,
    target: PhotoView,
    target_depth: Float[Tensor, "dh dw"] | None,
    config: LossConfig,
) -> Float[Tensor, ""]:
    grey = reference.grey.to(depth.dtype)
    big = enlarge_depth(depth, *grey.shape)
    image = target.grey.to(depth.dtype)
    warped = warp(image, big, reference.camera, target.camera, reference.T_cw, target.T_cw)
    mask = warped.in_view
    if target_depth is not None:
        tolerance = occlusion_tolerance(config, target.camera)
        mask = occlusion_mask(warped, target_depth, target.camera, tolerance)
    return photometric_loss(grey, warped.image, mask, config)


def photometric_loss(
    reference: Float[Tensor, "h w *c"],
    warped: Float[Tensor, "h w *c"],
    mask: Bool[Tensor, "h w"],
    config: LossConfig,
) -> Float[Tensor, ""]:
    """``lambda_1 L_1 + lambda_ssim L_ssim + lambda_ncc L_ncc``, sums over the number of pixels."""
    c, total = config, reference.new_zeros(())
    if c.l1_weight > 0:
        loss, _ = robust_l1(reference, warped, mask, c.l1_huber, c.l1_cut)
        total = total + c.l1_weight * loss.sum()
    if c.ssim_weight > 0:
        loss, _ = ssim(reference, warped, mask, MIN_COVERAGE)
        total = total + c.ssim_weight * loss.sum()
    if c.ncc_weight > 0:
        thresholds = c.ncc_reject, NCC_MIN_VARIANCE, c.ncc_texture, MIN_COVERAGE
        loss, _ = ncc(reference, warped, mask, c.ncc_patch, *thresholds)
        total = total + c.ncc_weight * loss.sum()
    return total / mask.numel()
